"""Filters and predictions over several frames, against textbook forms; the known input."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.plants import lbt_axis_plant, random_problem

import lbt_synth as lbt


def uncorrelated(problem):
    """The same problem with its measurement noise on columns of its own."""
    n, p = problem.B.shape
    q = problem.C.shape[0]
    return lbt.EstimationProblem(
        A=problem.A,
        B=np.hstack([problem.B, np.zeros((n, q))]),
        C=problem.C,
        D=np.hstack([np.zeros((q, p)), problem.D[:, :q] + 2 * np.eye(q)]),
        L=problem.L,
    )


@given(seed=st.integers(0, 10_000), n=st.integers(1, 4), q=st.integers(1, 2), l=st.integers(1, 2))
def test_kalman_filter_form(seed, n, q, l):
    """A-posteriori covariance ``P - P C'(C P C' + R)^-1 C P``, with correlated noise too."""
    p = random_problem(np.random.default_rng(seed), n, q, l=l)
    P = lbt.solve_dare(p.A.T, p.C.T, p.Q, p.R, p.S).X
    filtered = P - P @ p.C.T @ np.linalg.solve(p.C @ P @ p.C.T + p.R, p.C @ P)
    design = lbt.kalman(p, horizon=0)
    expected = np.trace(p.L @ filtered @ p.L.T)
    assert design.rms**2 == pytest.approx(expected, rel=1e-8, abs=1e-10 * np.trace(p.L @ P @ p.L.T))


@given(seed=st.integers(0, 10_000), n=st.integers(1, 4), steps=st.integers(2, 4))
def test_kalman_prediction_over_several_frames(seed, n, steps):
    p = uncorrelated(random_problem(np.random.default_rng(seed), n))
    P = lbt.solve_dare(p.A.T, p.C.T, p.Q, p.R).X
    for _ in range(steps - 1):
        P = p.A @ P @ p.A.T + p.Q
    design = lbt.kalman(p, horizon=steps)
    assert design.rms**2 == pytest.approx(np.trace(p.L @ P @ p.L.T), rel=1e-8)


def test_fixed_lag_smoothing():
    """Random walk, lag 1: P - P^2 / (P + R) - (P F)^2 / (P + R), F = R / (P + R)."""
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    P = (1 + np.sqrt(5)) / 2
    keep = 1 / (P + 1)
    expected = P - P**2 / (P + 1) - (P * keep) ** 2 / (P + 1)
    assert lbt.kalman(walk, horizon=-1).rms ** 2 == pytest.approx(expected, rel=1e-10)
    errors = [lbt.kalman(walk, horizon=h).rms for h in (-5, -3, -1, 0, 1, 2, 3)]
    assert errors == sorted(errors)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 3))
def test_more_measurements_lower_the_least_gamma(seed, n):
    p = uncorrelated(random_problem(np.random.default_rng(seed), n))
    least = [lbt.hinf(p, horizon=h, route="riccati").gamma_least for h in (-1, 0, 1, 2)]
    for earlier, later in itertools.pairwise(least):
        assert earlier <= later * (1 + 1e-9)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 3))
def test_hinf_filter_form_against_its_own_riccati_condition(seed, n):
    """Hassibi, Sayed, Kailath: the filter of a level exists iff P^-1 + C'R^-1 C - L'L / g^2 > 0."""
    p = uncorrelated(random_problem(np.random.default_rng(seed), n))
    least = lbt.hinf(p, horizon=0, route="riccati").gamma_least

    def exists(gamma):
        outputs = np.vstack([p.C, p.L])
        weight = np.diag(np.r_[np.diag(p.R), -(gamma**2) * np.ones(len(p.L))])
        try:
            P = lbt.solve_dare(p.A.T, outputs.T, p.Q, weight).X
        except (lbt.errors.SynthesisError, lbt.errors.DetectabilityError):
            return False
        P = P + 1e-12 * np.trace(P) * np.eye(n)
        information = np.linalg.inv(P) + p.C.T @ np.linalg.solve(p.R, p.C) - p.L.T @ p.L / gamma**2
        return bool(np.linalg.eigvalsh((information + information.T) / 2)[0] > 0)

    assert exists(1.01 * least)
    assert not exists(0.99 * least)


def test_correlated_noise_is_refused_beyond_one_frame():
    p = random_problem(np.random.default_rng(0), 3)
    assert lbt.kalman(p, horizon=0).certificate.passed
    with pytest.raises(
        lbt.errors.ProblemError, match="prediction of 2 samples needs .* uncorrelated"
    ):
        lbt.kalman(p, horizon=2)


@pytest.mark.parametrize("horizon", [1.0, "1", None, True, 101, -101])
def test_wrong_horizons(horizon):
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="horizon must be"):
        lbt.kalman(walk, horizon=horizon)


@pytest.mark.parametrize("method", ["kalman", "hinf"])
def test_a_horizon_is_a_delay_of_the_loop(method):
    """Plant with delay 2, filter or two-step prediction: the loops of delay 1 and 3."""
    make = {
        "kalman": lbt.kalman,
        "hinf": lambda p, **k: lbt.hinf(p, gamma_ratio=1.2, route="riccati", **k),
    }[method]
    for horizon, delay in ((0, 1), (2, 3), (3, 4)):
        shifted = make(lbt_axis_plant(), horizon=horizon)
        direct = make(lbt_axis_plant(delay_frames=delay))
        assert shifted.hardware.delay_frames == delay
        assert shifted.rms == pytest.approx(direct.rms, rel=1e-10)
        assert shifted.gamma == pytest.approx(direct.gamma, rel=1e-9)
        # and of the general construction, which knows nothing of telescopes
        p = lbt_axis_plant()
        bare = lbt.EstimationProblem(A=p.A, B=p.B, C=p.C, D=p.D, L=p.L, dt_s=p.dt_s)
        assert make(bare, horizon=horizon).rms == pytest.approx(direct.rms, rel=1e-9)
    with pytest.raises(lbt.errors.ProblemError, match="delay of 1 to 100 frames; got -1"):
        make(lbt_axis_plant(), horizon=-1)
    with pytest.raises(lbt.errors.ProblemError, match="horizon of 1; got 2"):
        make(lbt_axis_plant().full(), horizon=2)


@pytest.mark.parametrize("horizon", [0, 1, 2])
@pytest.mark.parametrize("delay", [2.0, 2.5, 3.0])
@pytest.mark.parametrize("full", [False, True])
def test_the_known_input_is_taken_out_exactly(horizon, delay, full):
    """Whatever the commands, the estimate is the same to rounding."""
    plant = lbt_axis_plant(modes=2, delay_frames=delay).ahead(horizon)
    design = lbt.kalman(plant.full() if full else plant)
    rng = np.random.default_rng(0)
    frames = 400
    hardware = plant.hardware
    commands = 1e3 * rng.standard_normal((frames, 2))
    phase = np.cumsum(rng.standard_normal((frames, 2)), axis=0)
    taps = hardware.mirror_taps
    measured, free = np.zeros((frames, 2)), np.zeros((frames, 2))
    for k in range(1, frames):
        # y(k) = phase(k-1) - N sum_i taps_i u(k-1-i): the commands that frame k-1 has seen
        free[k] = phase[k - 1]
        correction = sum(tap * commands[k - 1 - i] for i, tap in enumerate(taps) if k - 1 - i >= 0)
        measured[k] = free[k] - correction
    past = np.vstack([np.zeros((1, 2)), commands[:-1]])
    with_commands, without = design.estimator.start(), design.estimator.start()
    for k in range(frames):
        one = with_commands.step(np.r_[measured[k], past[k]])
        other = without.step(np.r_[free[k], np.zeros(2)])
        assert np.max(np.abs(one - other)) < 1e-7
