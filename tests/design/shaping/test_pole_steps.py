"""Poles moved until the objective is least."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import Channel, orthonormal_basis
from lbt_synth.design.shaping.pole_steps import settle_poles
from lbt_synth.design.shaping.reduction import solve_mode


@pytest.mark.parametrize("pole", [0.1, 0.97])
def test_a_pole_moves_to_that_of_the_kalman_filter(pole):
    """The best parameter for a first-order spectrum and noise has the Kalman filter's pole."""
    slow = lbt.models.ARModel(coefficients=[0.95], driving_rms_nm=40.0, frame_rate_hz=800)
    plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=80.0, modes=1)
    best = lbt.kalman(plant)
    truth = lbt.Truth(turbulence=slow, noise_nm=80.0)
    least = lbt.residual_budget(lbt.close_loop(plant.hardware, best.controller), truth).rms_nm
    term = lbt.design.shaping.ResidualVariance(turbulence=slow, noise_nm=80.0)
    spec = lbt.design.shaping.Specification(objective=term)
    basis = orthonormal_basis(np.array([pole]), dt_s=1 / 800)
    first = solve_mode(spec, Channel(hardware=plant.hardware, basis=basis))
    found = settle_poles(spec, first)
    assert first.objective_nm > 1.02 * least
    assert found.objective_nm == pytest.approx(least, rel=2e-4)
    poles = found.sequence.channel.basis.poles
    assert np.min(np.abs(poles - best.poles[:, None])) < 0.02
