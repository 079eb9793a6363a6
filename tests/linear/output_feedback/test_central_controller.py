"""The central controller of a level, against printed digits."""

from __future__ import annotations

import runpy

import numpy as np
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.linear.output_feedback.least_level import TwoRiccati


def test_sb10dd_the_published_digits():
    """SLICOT's printed controller, from two equations with indefinite weights."""
    script = runpy.run_path(str(ROOT / "examples" / "output_feedback.py"))
    parts = tuple(script[name] for name in "ABCD")
    plant = lbt.linear.GeneralizedPlant.of(parts, measurements=2, controls=2)
    equations = TwoRiccati(plant)
    K = equations.controller(equations.solve(111.294)[1])
    controller = [getattr(K, name) for name in "ABCD"]
    printed = (
        [
            [-18.0030, 52.0376, 26.0831, -0.4271, -40.9022, 18.0857],
            [18.8203, -57.6244, -29.0938, 0.5870, 45.3309, -19.8644],
            [-26.5994, 77.9693, 39.0368, -1.4020, -60.1129, 26.6910],
            [-21.4163, 62.1719, 30.7507, -0.9201, -48.6221, 21.8351],
            [-0.8911, 4.2787, 2.3286, -0.2424, -3.0376, 1.2169],
            [-5.3286, 16.1955, 8.4824, -0.2489, -12.2348, 5.1590],
        ],
        [
            [16.9788, 14.1648],
            [-18.9215, -15.6726],
            [25.2046, 21.2848],
            [20.1122, 16.8322],
            [1.4104, 1.2040],
            [5.3181, 4.5149],
        ],
        [
            [-9.1941, 27.5165, 13.7364, -0.3639, -21.5983, 9.6025],
            [3.6490, -10.6194, -5.2772, 0.2432, 8.1108, -3.6293],
        ],
        [[9.0317, 7.5348], [-3.4006, -2.8219]],
    )
    for found, digits in zip(controller, printed, strict=True):
        assert np.max(np.abs(found - digits)) < 5.1e-5
    assert float(lbt.hinf_norm(plant.closed_loop(K))) < 111.294
    assert lbt.hinf_controller(plant, gamma=111.294).gamma < 111.294
