"""Kalman filters against other solvers and recursions."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from support.plants import random_problem
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError


def test_kalman_by_sdp(axis_plant):
    design, sdp = lbt.kalman(axis_plant), lbt.kalman(axis_plant, route="sdp")
    assert np.allclose(sdp.gain_predictor, design.gain_predictor, rtol=1e-6)
    assert sdp.rms == pytest.approx(design.rms, rel=1e-9)
    assert sdp.solver.route == "sdp"


@settings(max_examples=20)
@given(seed=st.integers(0, 9999), n=st.integers(1, 4), q=st.integers(1, 2), steps=st.integers(0, 4))
def test_filters_and_predictions_are_those_of_the_recursion(seed, n, q, steps):
    """A-posteriori covariance ``P - P C'(C P C' + R)^-1 C P``, with correlated noise too."""
    p = random_problem(np.random.default_rng(seed), n, q, l=q)
    if steps > 1:  # the noise of the measurements has columns of its own
        noise = np.hstack([0 * p.D, p.D[:, :q] + 2 * np.eye(q)])
        p = replace(p, B=np.hstack([p.B, np.zeros((n, q))]), D=noise)
    P = lbt.solve_dare(p.A.T, p.C.T, p.Q, p.R, p.S).X
    scale = np.trace(p.L @ P @ p.L.T)
    if steps == 0:
        P = P - P @ p.C.T @ np.linalg.solve(p.C @ P @ p.C.T + p.R, p.C @ P)
    for _ in range(steps - 1):
        P = p.A @ P @ p.A.T + p.Q
    expected = np.trace(p.L @ P @ p.L.T)
    rms = lbt.kalman(p.ahead(steps)).rms
    assert rms**2 == pytest.approx(expected, rel=1e-8, abs=1e-10 * scale)


WALK = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)


def test_fixed_lag_smoothing():
    """Random walk, lag 1: P - P^2 / (P + R) - (P F)^2 / (P + R), F = R / (P + R)."""
    P = (1 + np.sqrt(5)) / 2
    keep = 1 / (P + 1)
    expected = P - P**2 / (P + 1) - (P * keep) ** 2 / (P + 1)
    assert lbt.kalman(WALK.ahead(-1)).rms ** 2 == pytest.approx(expected, rel=1e-10)
    errors = [lbt.kalman(WALK.ahead(h)).rms for h in (-5, -3, -1, 0, 1, 2, 3)]
    assert errors == sorted(errors)


def test_wrong_horizons():
    p = random_problem(np.random.default_rng(0), 3)
    correlated = "prediction of 2 samples needs .* uncorrelated"
    rows = [(lambda: lbt.kalman(p.ahead(2)), ProblemError, correlated)]
    wrong = (1.0, "1", None, True, 101, -101)
    rows += [(lambda k=frames: WALK.ahead(k), ProblemError, "frames must be") for frames in wrong]
    require_refusals(rows)


def random_plant(rng):
    """One axis with 1 to 6 vibrations, AR1 or AR2 turbulence, noise over six decades."""
    if rng.random() < 0.5:
        coefficients = [rng.uniform(0.9, 0.9999)]
    else:
        slow, damping = 2 * np.pi * rng.uniform(0.2, 5) / 800, rng.uniform(0.05, 0.9)
        decay = np.exp(-damping * slow)
        coefficients = [2 * decay * np.cos(slow * np.sqrt(1 - damping**2)), -(decay**2)]
    facts = {"coefficients": coefficients, "frame_rate_hz": 800}
    unit = lbt.models.ARModel(**facts, driving_rms_nm=1.0)
    lines = [
        lbt.Vibration(frequency_hz=f, damping=10**k, rms_nm=10**size, direction=(1,))
        for f, k, size in rng.uniform((5, -4, 0), (150, -1, 3), (rng.integers(1, 7), 3))
    ]
    return lbt.tip_tilt_plant(
        frame_rate_hz=800,
        delay_frames=int(rng.integers(1, 4)),
        turbulence=lbt.models.ARModel(**facts, driving_rms_nm=600 / unit.rms_nm),
        vibrations=lines,
        noise_nm=10 ** rng.uniform(-3, 3),
        modes=1,
    )


def plain_residual(plant, P):
    """Return the relative residual of the filter equation in the 1-norm, in double precision."""
    cross, APA = plant.C @ P @ plant.A.T, plant.A @ P @ plant.A.T
    gain = np.linalg.solve(plant.R + plant.C @ P @ plant.C.T, cross)
    residual = APA - P + plant.Q - cross.T @ gain
    return np.linalg.norm(residual, 1) / sum(np.linalg.norm(t, 1) for t in (P, APA, plant.Q))


@pytest.mark.study
def test_ten_thousand_random_plants_of_this_field(capsys):
    """Each equation is solved and stable; the plants on which scipy fails are counted beside."""
    rng = np.random.default_rng(0)
    worst, plain, radius, failures, wrong = 0.0, 0.0, 0.0, 0, 0
    for _ in range(10_000):
        plant = random_plant(rng)
        parts = (plant.A.T, plant.C.T, plant.Q, plant.R)
        solution = lbt.solve_dare(*parts)
        worst, plain = max(worst, solution.residual), max(plain, plain_residual(plant, solution.X))
        radius = max(radius, float(np.max(np.abs(solution.poles))))
        try:
            X = scipy.linalg.solve_discrete_are(*parts)
            gain = np.linalg.solve(plant.R + plant.C @ X @ plant.C.T, plant.C @ X @ plant.A.T)
            wrong += not np.max(np.abs(np.linalg.eigvals(plant.A - gain.T @ plant.C))) < 1
        except (np.linalg.LinAlgError, ValueError):
            failures += 1
    with capsys.disabled():
        print(
            f"\nworst residual {worst:.2g} in balanced units, {plain:.2g} in the plant's, largest "
            f"radius 1 - {1 - radius:.2g}; scipy refused {failures}, {wrong} filters were unstable"
        )
    assert max(worst, plain) < 1e-12
    assert radius < 1
