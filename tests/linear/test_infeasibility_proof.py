"""The proof that no filter reaches a level, and proofs that are none."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.plants import random_problem

import lbt_synth as lbt
from lbt_synth.linear.infeasibility_proof import Witness


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
    witness = Witness(states=states, disturbances=disturbances)
    least = lbt.hinf(problem, route="riccati").gamma_least
    assert lbt.linear.infeasible_level(problem, witness, covariance) <= least * (1 + 1e-9)
    assert least <= kalman.gamma * (1 + 1e-9)


def test_a_forged_claim_is_found_out(axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.2, route="riccati")
    assert design.recertify().passed
    forged = dataclasses.replace(
        design, claims={**design.claims, "gamma_infeasible": 1.001 * design.gamma_infeasible}
    )
    failed = [check.name for check in forged.recertify().checks if not check.passed]
    assert failed == ["infeasible level over the level proved, less 1"]
    with pytest.raises(lbt.errors.DimensionError, match="a witness must have 4 rows of states"):
        lbt.design.certify_infeasible(
            axis_plant, 1.0, Witness(states=np.ones((3, 1)), disturbances=np.ones((3, 1)))
        )


def test_states_without_error_prove_nothing():
    """A direction in which no filter errs has no price: a witness that uses it is worth nothing."""
    p = lbt.EstimationProblem(
        A=np.diag([0.9, 0.5]), B=[[1, 0], [0, 0]], C=[[1, 0]], D=[[0, 1]], L=[[1, 1]]
    )
    free = Witness(states=[[0.0], [1.0]], disturbances=[[1e-6], [0.0]])
    assert not lbt.design.certify_infeasible(p, 1e5, free).passed
    least = lbt.hinf(p, route="riccati").gamma_least
    assert least == pytest.approx(1.34536, abs=1e-5)
    extended = lbt.mixed(p, gamma_ratio=1.01, taps=3).problem
    memory = np.eye(extended.n_states)[:, -2:]
    assert not lbt.design.certify_infeasible(
        extended, 1.1 * least, Witness(states=memory, disturbances=1e-6 * np.ones((2, 2)))
    ).passed


def test_claims_need_a_proof_and_must_fit_the_filter(axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.2, route="riccati")
    bare = dataclasses.replace(design, witness=None)
    assert not bare.recertify().passed
    with pytest.raises(lbt.errors.DimensionError, match="states must be a matrix"):
        Witness(states=np.zeros(2), disturbances=np.zeros(2))
    with pytest.raises(lbt.errors.DimensionError, match="disturbances must have 3 columns"):
        Witness(states=np.zeros((2, 3)), disturbances=np.zeros((2, 2)))
    with pytest.raises(lbt.errors.NonFiniteError):
        Witness(states=[[np.nan]], disturbances=[[1.0]])
    with pytest.raises(lbt.errors.ProblemError, match="level must be at least 0"):
        lbt.design.certify_infeasible(axis_plant, -5.0, design.witness)


def test_a_witness_has_the_period_of_its_problem(axis_plant):
    states, disturbances = np.ones((2, 4, 1)), np.ones((2, axis_plant.B.shape[1], 1))
    witness = Witness(states=states, disturbances=disturbances)
    with pytest.raises(lbt.errors.DimensionError, match="period of the problem, 1; got 2"):
        lbt.linear.infeasible_level(axis_plant, witness, np.eye(4))
    with pytest.raises(lbt.errors.DimensionError, match="must have the same phases"):
        Witness(states=states, disturbances=disturbances[0])
    assert Witness(states=states[:1], disturbances=disturbances[:1]).states.shape == (4, 1)
