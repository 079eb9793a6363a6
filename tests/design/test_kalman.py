"""Kalman filters against other solvers and recursions."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from support.plants import lbt_axis_plant, random_problem
from support.uneven_axes import QUICK, RATE, SLOW

import lbt_synth as lbt
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual


@pytest.mark.parametrize("modes", [1, 2])
def test_kalman_by_sdp_agrees_with_the_riccati_equation(modes):
    plant = lbt_axis_plant(modes=modes)
    riccati, sdp = (lbt.kalman(plant, route=m) for m in ("riccati", "sdp"))
    for name in ("gain_predictor", "gain_filter"):
        one, other = getattr(riccati, name), getattr(sdp, name)
        assert np.linalg.norm(one - other) / np.linalg.norm(one) < 1e-6
    assert sdp.rms == pytest.approx(riccati.rms, rel=1e-9)


def test_kalman_against_a_long_recursion(axis_plant):
    """The textbook time-varying filter, run until it stands still."""
    p = axis_plant
    P = np.zeros((4, 4))
    for _ in range(20_000):
        gain = p.A @ P @ p.C.T / (p.C @ P @ p.C.T + p.R)
        P = p.A @ P @ p.A.T + p.Q - gain @ (p.C @ P @ p.A.T)
    design = lbt.kalman(p)
    assert np.allclose(design.gain_predictor, gain, rtol=1e-8)
    assert np.allclose(p.A @ design.gain_filter, design.gain_predictor, rtol=1e-10)


def test_kalman_gains_with_correlated_noise():
    problem = random_problem(np.random.default_rng(8), 3, 2)
    P = scipy.linalg.solve_discrete_are(problem.A.T, problem.C.T, problem.Q, problem.R, s=problem.S)
    innovation = problem.C @ P @ problem.C.T + problem.R
    predictor = (problem.A @ P @ problem.C.T + problem.S) @ np.linalg.inv(innovation)
    design = lbt.kalman(problem)
    assert np.allclose(design.gain_predictor, predictor, rtol=1e-8)
    assert np.allclose(design.gain_filter, P @ problem.C.T @ np.linalg.inv(innovation), rtol=1e-8)


def test_the_plant_of_uneven_axes_is_two_plants():
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=[SLOW, QUICK], noise_nm=[15.5, 6.0], sensor_gain=[0.9, 0.7]
    )
    np.testing.assert_array_equal(plant.hardware.sensor, np.diag([0.9, 0.7]))
    np.testing.assert_allclose(plant.R, np.diag([15.5, 6.0]) ** 2, rtol=1e-14)
    both = lbt.kalman(plant)
    alone = [
        lbt.kalman(
            lbt.tip_tilt_plant(
                frame_rate_hz=RATE, turbulence=model, noise_nm=noise, sensor_gain=gain, modes=1
            )
        ).rms
        for model, noise, gain in ((SLOW, 15.5, 0.9), (QUICK, 6.0, 0.7))
    ]
    assert both.rms == pytest.approx(np.hypot(*alone), rel=1e-9)
    limit = least_model_residual(plant)
    np.testing.assert_allclose(np.sqrt(limit.variance_nm2), alone, rtol=1e-6)
