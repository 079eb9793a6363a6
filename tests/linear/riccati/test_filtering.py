"""The Riccati equations of the predictors of any period, against other programs; least gamma."""

from dataclasses import replace
from functools import partial

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.periodic_problems import lifted_problem, random_periodic_problem, relative_distance
from support.plants import random_problem
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.design.certificate import certify_filter
from lbt_synth.errors import DetectabilityError, InfeasibleError, NumericalError
from lbt_synth.linear import EstimationProblem
from lbt_synth.linear.infeasibility_proof import infeasible_level, worst_invisible_disturbance
from lbt_synth.linear.riccati import filtering
from lbt_synth.linear.riccati.filtering import gamma_riccati, kalman_riccati, least_gamma


def test_a_measurement_that_is_not_read_is_left_out():
    """Filters and least gamma are those of the others; its own gains are zero."""
    problem, rows = random_problem(np.random.default_rng(1), 4, 3, l=2), [0, 2]
    masked = replace(problem, read=[[True, False, True]])
    less = replace(problem, C=problem.C[rows], D=problem.D[rows], read=None)
    upper = lbt.hinf_norm(less.error_system(kalman_riccati(less).gain_predictor)).upper
    level, some, others = (least_gamma(p, lower=0.1, upper=upper) for p in (problem, masked, less))
    assert some[:2] == others[:2]
    assert level[1] < some[1]
    solutions = [[kalman_riccati(p), gamma_riccati(p, upper)] for p in (masked, less)]
    for ours, own in zip([*solutions[0], some[2]], [*solutions[1], others[2]], strict=True):
        np.testing.assert_array_equal(ours.P, own.P)
        np.testing.assert_array_equal(ours.gain_predictor[:, rows], own.gain_predictor)
        assert not ours.gain_predictor[:, 1].any()
    assert gamma_riccati(masked, 0.5 * some[0]) is None


def scalar(a, q, r):
    return lbt.EstimationProblem(A=a, B=[[np.sqrt(q), 0.0]], C=1.0, D=[[0.0, np.sqrt(r)]], L=1.0)


def closed_form(a, q, r, horizon):
    """Least gamma of ``x+ = a x + v``, ``y = x + w``, ``z = x``, variances q and r.

    With s = 1 / r and mu = s - 1 / gamma^2 the equation is mu P^2 + (1 - a^2 - q mu) P = q, and
    its stabilising root has |a| < 1 + mu P. The filter needs 1 + mu P > 0 only: gamma falls
    until both roots meet, at q mu = -(1 - |a|)^2; from |a| = 1 up mu cannot be negative. The
    predictor needs P < gamma^2 too, which P = gamma^2 = q + a^2 r ends unless the roots have
    met before. The roots meet in a constant that no measurement shows.
    """
    drift = max(1 - abs(a), 0.0)
    steady = np.sqrt(q / (q / r + drift**2))
    if horizon == 0 or (abs(a) < 1 and q / r <= abs(a) * drift):
        return steady
    return np.sqrt(q + a**2 * r)


CORNERS = [(a, 1.0, 1.0) for a in (0.0, 0.3, -0.7, 0.9, 0.9999, 1.0, -1.0, 1.2, -1.5)]
CORNERS += [(a, q, r) for a in (0.3, 0.9, 1.2) for q, r in ((1e-4, 25.0), (1e4, 1e-4))]


@pytest.mark.parametrize("horizon", [0, 1])
def test_scalar_closed_forms(horizon):
    for i, (a, q, r) in enumerate(CORNERS):
        exact = closed_form(a, q, r, horizon)
        for route, rel in (("riccati", 1e-8), ("lmi", 1e-7))[: 2 if i % 4 == 1 else 1]:
            design = lbt.hinf(scalar(a, q, r).ahead(horizon), route=route)
            assert design.gamma_least == pytest.approx(exact, rel=rel), (a, q, r)
            assert design.gamma_infeasible == pytest.approx(exact, rel=rel), (a, q, r)


@settings(max_examples=12)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), q=st.integers(1, 2), l=st.integers(1, 2))
def test_the_bracket_is_closed(seed, n, q, l):
    problem = random_problem(np.random.default_rng(seed), n, q, l=l)
    riccati = lbt.hinf(problem, route="riccati")
    assert riccati.gamma_infeasible <= riccati.gamma_least
    assert riccati.gamma_least / riccati.gamma_infeasible - 1 < 1e-8
    assert riccati.gamma <= riccati.gamma_least * (1 + 1e-12)
    lmi = lbt.hinf(problem)
    assert lmi.gamma_infeasible <= riccati.gamma_least * (1 + 1e-9)
    assert riccati.gamma_infeasible <= lmi.gamma_least * (1 + 1e-9)
    assert lmi.gamma_least == pytest.approx(riccati.gamma_least, rel=1e-6)
    kalman = lbt.kalman(problem)  # each filter is the best by its own measure
    assert kalman.rms <= riccati.rms * (1 + 1e-9)
    assert riccati.gamma <= kalman.gamma * (1 + 1e-9)


def doubled(plant):
    """Solve the Riccati equation of a plant by structured doubling in 60 digits."""
    assert not np.any(plant.S)
    with mpmath.workdps(60):
        A, C, H, R = (mpmath.matrix(each.tolist()) for each in (plant.A, plant.C, plant.Q, plant.R))
        F, G, one = A.T, C.T * R**-1 * C, mpmath.eye(A.rows)
        last = mpmath.zeros(A.rows)
        while mpmath.mnorm(H - last, 1) > 1e-40 * mpmath.mnorm(H, 1):
            middle, last = (one + G * H) ** -1, H
            F, G, H = F * middle * F, G + F * middle * G * F.T, H + F.T * H * middle * F
        return np.array(H.tolist(), dtype=np.float64)


@pytest.mark.parametrize(
    ("rate_hz", "frequency_hz", "damping", "rms_nm", "noise_nm"),
    [
        (2000, 1.076, 1.1e-3, 34.5, 175),
        (4000, 0.5, 1e-5, 1.0, 1000),
        (4000, 1.0, 1e-5, 300.0, 1.0),
        (100, 0.5, 1e-5, 1.0, 1000),
    ],
)
def test_a_slow_line_is_no_line_without_damping(rate_hz, frequency_hz, damping, rms_nm, noise_nm):
    """Its pole is at 1e-8 to 1e-4 inside the circle, further than rounding can move it."""
    air = lbt.models.ARModel(coefficients=[0.9986], driving_rms_nm=22.7, frame_rate_hz=rate_hz)
    line = lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=rms_nm, direction=(1,))
    facts = {"frame_rate_hz": rate_hz, "noise_nm": noise_nm, "modes": 1}
    plant = lbt.tip_tilt_plant(turbulence=air, vibrations=[line], **facts)
    solution = kalman_riccati(plant)
    assert solution.P == pytest.approx(doubled(plant), rel=5e-6)  # scipy's is off by up to 4e-5
    assert certify_filter(plant, solution.gain_predictor, least_variance=True).passed


@pytest.mark.parametrize("seed", range(8))
def test_kalman_filter_of_the_lifted_problem(seed):
    problem = random_periodic_problem(seed)
    solution = kalman_riccati(problem)
    covariances = problem.error_system(solution.gain_predictor).covariances()
    assert relative_distance(covariances, solution.P) < 1e-9
    lifted = kalman_riccati(lifted_problem(problem))
    assert relative_distance(solution.P[0], lifted.P) < 1e-9
    assert not np.any(solution.gain_predictor.transpose(0, 2, 1)[~problem.read])


@pytest.mark.parametrize("seed", range(2))
def test_the_gain_without_correlation_by_the_covariance_that_a_level_widens(seed):
    """It is ``A Pt C'(R + C Pt C')^-1``, with P itself for the Kalman filter."""
    problem = random_periodic_problem(seed)
    own = np.arange(problem.B.shape[-1]) < problem.n_states
    alone = replace(problem, B=problem.B * own, D=problem.D * ~own)
    start, L = kalman_riccati(alone), alone.L
    level = 1.2 * lbt.hinf_norm(alone.error_system(start.gain_predictor)).upper
    for gamma, solution in ((np.inf, start), (level, gamma_riccati(alone, level, start=start))):
        expected = np.zeros_like(solution.gain_predictor)
        for t, P in enumerate(solution.P):
            A, _, C, D = alone.read_parts(t)
            room = np.eye(len(L)) - L @ P @ L.T / gamma**2
            wide = P + P @ L.T @ np.linalg.solve(room, L @ P) / gamma**2
            gain = A @ wide @ C.T @ np.linalg.inv(C @ wide @ C.T + D @ D.T)
            expected[t][:, alone.read[t]] = gain
        assert relative_distance(solution.gain_predictor, expected) < 1e-9


@pytest.mark.parametrize("seed", range(0, 12, 4))
def test_the_error_of_an_hinf_filter_is_below_its_level(seed):
    problem = random_periodic_problem(seed)
    start = kalman_riccati(problem)
    kalman = lbt.hinf_norm(problem.error_system(start.gain_predictor)).upper
    below, least, solution = least_gamma(problem, lower=0.0, upper=kalman)
    assert (1 - 2e-11) * least < below < least <= kalman * (1 + 1e-9)
    # the worst disturbance proves a level infeasible
    witness = worst_invisible_disturbance(problem, solution.P, least, start.P)
    assert 0.99 * least < infeasible_level(problem, witness, start.P) <= least
    for level in (1.001 * least, 1.3 * least):
        gain = gamma_riccati(problem, level, start=start).gain_predictor
        assert lbt.hinf_norm(problem.error_system(gain)).value < level
    assert gamma_riccati(problem, 0.999 * least, start=start) is None
    # far above the least level it is the Kalman filter
    far = gamma_riccati(problem, 1e6 * least).gain_predictor
    assert relative_distance(far, start.gain_predictor) < 1e-9


def walk(**changes):
    parts = {"A": [[[1.0]]], "B": [[[1.0, 0.0]]], "C": [[[1.0]]], "D": [[[0.0, 1.0]]]}
    return EstimationProblem(**(parts | changes), L=[[1.0]], read=[[True], [False]])


def test_equations_that_are_not_solved(monkeypatch):
    problem, unread = walk(), np.zeros((1, 1))
    hidden = EstimationProblem(
        A=np.diag([1.1, 0.5]),
        B=[np.eye(2, 3)],
        C=[[[0.0, 1.0]]],
        D=[[[0.0, 0.0, 1.0]]],
        L=[[1.0, 0.0]],
        read=[[True], [False]],
    )
    least, short = partial(least_gamma, problem, lower=0.0), "solved only to a relative"
    rows = [
        (partial(kalman_riccati, hidden), DetectabilityError, r"1\.21.*no measurement sees it"),
        (partial(least, upper=0.1), InfeasibleError, "no gamma up to"),
        (
            lambda: filtering._settle_phases(walk(A=[[[1.1]]]), unread),
            NumericalError,
            f"{short} inf",
        ),
    ]
    require_refusals(rows)
    for limit, call, words in (
        ("ERROR_LIMIT", partial(kalman_riccati, walk()), short),
        ("_RESIDUAL_LIMIT", partial(gamma_riccati, problem, 10.0), f"{short} residual of"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(filtering, limit, -1.0)
            refused(call, NumericalError, words)
    monkeypatch.setattr(filtering.GammaEquation, "solution", lambda *_: None)
    refused(partial(least, upper=10.0), NumericalError, "the least gamma was not bracketed")
