"""Integrators of the best gains."""

from __future__ import annotations

import numpy as np
import pytest
from support.league import GAIN, PATH, TRUTH, short_split

import lbt_synth as lbt
from lbt_synth.studies.league.integrators import hindsight_integrators, optimised_integrators


@pytest.fixture(scope="module")
def split():
    return short_split()


def gains_on(split, controller):
    return controller.B * split.hardware.sensor


def test_the_optimised_gain_is_that_of_the_truth(split):
    best = lbt.design.optimal_integrator(PATH, TRUTH).gain
    found = gains_on(split, optimised_integrators(split)).item()
    assert found * 1.0 == pytest.approx(best * GAIN, rel=0.15)  # of the whole loop


def test_hindsight_leaves_least_of_the_test(split):
    best = gains_on(split, hindsight_integrators(split)).item()

    def left(gain):
        path = lbt.LoopHardware(frame_rate_hz=500, modes=1, sensor_matrix=split.hardware.sensor)
        controller = lbt.integrator(path, gain=gain).controller
        return np.mean(split.replay(controller) ** 2)

    assert left(best) <= min(left(gain) for gain in np.linspace(0.05, 0.95, 19)) * (1 + 1e-9)
    assert np.mean(split.replay(hindsight_integrators(split)) ** 2) == pytest.approx(left(best))
