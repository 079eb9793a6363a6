"""The least gamma from both sides: closed forms, brackets, and the proof of the lower one."""

from __future__ import annotations

import dataclasses

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.plants import lbt_axis_plant, random_problem

import lbt_synth as lbt


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


@pytest.mark.parametrize("horizon", [0, 1])
@pytest.mark.parametrize("a", [0.0, 0.3, -0.7, 0.9, 0.99, 0.9999, 1.0, -1.0, 1.2, -1.5])
def test_scalar_closed_forms(a, horizon):
    for q in (1.0, 1e-4, 1e4):
        for r in (1.0, 1e-4, 25.0):
            exact = closed_form(a, q, r, horizon)
            design = lbt.hinf(scalar(a, q, r), horizon=horizon, route="riccati")
            assert design.gamma_least == pytest.approx(exact, rel=1e-8)
            assert design.gamma_infeasible == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("horizon", [0, 1])
def test_scalar_closed_forms_by_lmi(horizon):
    for a, q, r in ((0.3, 1, 25), (0.9, 1, 1), (1.0, 1, 1), (1.2, 1, 4)):
        exact = closed_form(a, q, r, horizon)
        design = lbt.hinf(scalar(a, q, r), horizon=horizon)
        assert design.gamma_least == pytest.approx(exact, rel=1e-7)
        assert design.gamma_infeasible == pytest.approx(exact, rel=1e-7)


@settings(max_examples=25)
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


def test_both_routes_agree_on_the_lbt():
    for modes in (1, 2):
        plant = lbt_axis_plant(modes=modes)
        riccati, lmi = lbt.hinf(plant, route="riccati"), lbt.hinf(plant)
        assert riccati.gamma_least / riccati.gamma_infeasible - 1 < 1e-10
        assert lmi.gamma_least == pytest.approx(riccati.gamma_least, rel=1e-7)
        assert lmi.gamma_infeasible == pytest.approx(riccati.gamma_least, rel=1e-7)


def whole_lmi_is_feasible(problem, gamma):
    """The textbook inequality with the gain as an unknown, nothing of this package in it."""
    n, p = problem.B.shape
    q, l = problem.C.shape[0], problem.L.shape[0]
    P, Y = cp.Variable((n, n), symmetric=True), cp.Variable((n, q))
    step = P @ problem.A - Y @ problem.C
    push = P @ problem.B - Y @ problem.D
    block = cp.bmat(
        [
            [P, np.zeros((n, p)), step.T, problem.L.T],
            [np.zeros((p, n)), gamma**2 * np.eye(p), push.T, np.zeros((p, l))],
            [step, push, P, np.zeros((n, l))],
            [problem.L, np.zeros((l, p)), np.zeros((l, n)), np.eye(l)],
        ]
    )
    margin = cp.Variable()
    programme = cp.Problem(
        cp.Maximize(margin),
        [(block + block.T) / 2 >> margin * np.eye(2 * n + p + l), margin <= 1, cp.trace(P) <= 1e6],
    )
    programme.solve(solver=cp.CLARABEL)
    return margin.value > 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_the_bracket_against_the_textbook_inequality(seed):
    problem = random_problem(np.random.default_rng(seed), 3)
    design = lbt.hinf(problem, route="riccati")
    assert whole_lmi_is_feasible(problem, 1.01 * design.gamma_least)
    assert not whole_lmi_is_feasible(problem, 0.99 * design.gamma_infeasible)


def test_the_witness_is_a_signal_that_no_measurement_shows(axis_plant):
    """Play the burst: y stays zero, and z has gamma times the energy of w."""
    p = axis_plant
    design = lbt.hinf(p, route="riccati")
    x, w = design.witness.states, design.witness.disturbances
    size = np.linalg.norm(p.C, 2) * np.linalg.norm(x, 2) + np.linalg.norm(p.D, 2) * np.linalg.norm(
        w, 2
    )
    assert np.linalg.norm(p.C @ x + p.D @ w) < 1e-9 * size
    after = p.A @ x + p.B @ w
    growth = after @ after.T - x @ x.T
    scale = np.sqrt(np.outer(np.diag(after @ after.T), np.diag(after @ after.T)))
    assert np.linalg.eigvalsh(growth / scale)[0] > -1e-9
    ratio = np.linalg.norm(p.L @ after) / np.linalg.norm(w)
    assert ratio == pytest.approx(design.gamma_infeasible, rel=1e-6)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 4), r=st.integers(1, 5))
def test_no_witness_proves_too_much(seed, n, r):
    """Whatever the pairs of states and disturbances, the level stays below the norm of a filter."""
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, n)
    kalman = lbt.kalman(problem)
    covariance = lbt.solve_dare(problem.A.T, problem.C.T, problem.Q, problem.R, problem.S).X
    states = rng.standard_normal((n, r)) * rng.choice([0.0, 1e-3, 1.0])
    disturbances = rng.standard_normal((problem.B.shape[1], r))
    witness = lbt.linear.Witness(states=states, disturbances=disturbances)
    least = lbt.hinf(problem, route="riccati").gamma_least
    assert lbt.linear.infeasible_level(problem, witness, covariance) <= least * (1 + 1e-9)
    assert least <= kalman.gamma * (1 + 1e-9)


def test_a_forged_claim_is_found_out(axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.2, route="riccati")
    assert design.recertify().passed
    forged = dataclasses.replace(design, gamma_infeasible=1.001 * design.gamma_infeasible)
    failed = [check.name for check in forged.recertify().checks if not check.passed]
    assert failed == ["infeasible level over the level proved, less 1"]
    with pytest.raises(lbt.errors.DimensionError, match="a witness must have 4 rows of states"):
        lbt.design.certify_infeasible(
            axis_plant,
            1.0,
            lbt.linear.Witness(states=np.ones((3, 1)), disturbances=np.ones((3, 1))),
        )


def test_the_proof_travels_with_the_gain_file(tmp_path, axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.1)
    for ending in (".fits", ".npz", ".json"):
        loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"g{ending}", design))
        assert loaded.gamma_infeasible == design.gamma_infeasible
        assert np.array_equal(loaded.witness.states, design.witness.states)
        assert loaded.recertify().passed


def test_states_without_error_prove_nothing():
    """A direction in which no filter errs has no price: a witness that uses it is worth nothing."""
    p = lbt.EstimationProblem(
        A=np.diag([0.9, 0.5]), B=[[1, 0], [0, 0]], C=[[1, 0]], D=[[0, 1]], L=[[1, 1]]
    )
    free = lbt.linear.Witness(states=[[0.0], [1.0]], disturbances=[[1e-6], [0.0]])
    assert not lbt.design.certify_infeasible(p, 1e5, free).passed
    least = lbt.hinf(p, route="riccati").gamma_least
    assert least == pytest.approx(1.34536, abs=1e-5)
    extended = lbt.mixed(p, gamma_ratio=1.01, taps=3).problem
    memory = np.eye(extended.n_states)[:, -2:]
    assert not lbt.design.certify_infeasible(
        extended,
        1.1 * least,
        lbt.linear.Witness(states=memory, disturbances=1e-6 * np.ones((2, 2))),
    ).passed


def test_claims_need_a_proof_and_must_fit_the_filter(axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.2, route="riccati")
    bare = dataclasses.replace(design, witness=None)
    assert not bare.recertify().passed
    with pytest.raises(lbt.errors.DimensionError, match="states must be a matrix"):
        lbt.linear.Witness(states=np.zeros(2), disturbances=np.zeros(2))
    with pytest.raises(lbt.errors.DimensionError, match="disturbances must have 3 columns"):
        lbt.linear.Witness(states=np.zeros((2, 3)), disturbances=np.zeros((2, 2)))
    with pytest.raises(lbt.errors.NonFiniteError):
        lbt.linear.Witness(states=[[np.nan]], disturbances=[[1.0]])
    with pytest.raises(lbt.errors.ProblemError, match="level must be above 0"):
        lbt.design.certify_infeasible(axis_plant, -5.0, design.witness)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_the_bracket_does_not_depend_on_the_units_of_states(seed):
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, 4)
    units = 10.0 ** rng.uniform(-5, 5, 4)
    scaled = lbt.EstimationProblem(
        A=problem.A * units[:, None] / units,
        B=problem.B * units[:, None],
        C=problem.C / units,
        D=problem.D,
        L=problem.L / units,
    )
    one, other = (lbt.hinf(p, route="riccati") for p in (problem, scaled))
    assert other.gamma_least == pytest.approx(one.gamma_least, rel=1e-8)
    assert other.gamma_infeasible == pytest.approx(one.gamma_infeasible, rel=1e-8)
