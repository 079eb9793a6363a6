"""The robustness map of axes with different turbulence and noise."""

from __future__ import annotations

import pytest
from support.uneven_axes import LINES, LOOPS, SLOW, TABLE

import lbt_synth as lbt


def test_the_map_is_the_budget_at_each_point():
    both, _ = LOOPS
    truth = lbt.Truth(turbulence=[SLOW, TABLE], noise_nm=[15.5, 6.0], vibrations=LINES)
    design = lbt.integrator(both, gain=0.4)
    camera = lbt.Imaging(diameter_m=8.22)
    found = lbt.studies.robustness_map(
        design, truth, camera, errors_hz=[0], sensor_gains=[0.6, 1.0]
    )
    for i, gain in enumerate([0.6, 1.0]):
        loop = lbt.close_loop(both, design.controller, sensor_gain=gain)
        real = lbt.Truth(
            turbulence=truth.turbulence, noise_nm=truth.noise_nm, vibrations=LINES, sensor_gain=gain
        )
        budget = lbt.residual_budget(loop, real)
        assert found.residual_nm[0, i, 0] == pytest.approx(budget.rms_nm, rel=1e-8)
        assert found.strehl[0, i, 0] == pytest.approx(lbt.strehl(budget, camera), rel=1e-8)
