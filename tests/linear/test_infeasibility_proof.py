"""The proof that no filter reaches a level, and proofs that are none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.plants import random_problem
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.design.certificate import certify_infeasible
from lbt_synth.errors import DimensionError, NonFiniteError
from lbt_synth.linear.infeasibility_proof import Witness, infeasible_level
from lbt_synth.linear.riccati.filtering import kalman_riccati


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 4), r=st.integers(1, 5))
def test_no_witness_proves_too_much(seed, n, r):
    """Whatever the pairs of states and disturbances, the level stays below the norm of a filter."""
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, n)
    covariance = kalman_riccati(problem).P
    states = rng.standard_normal((n, r)) * rng.choice([0.0, 1e-3, 1.0])
    disturbances = rng.standard_normal((problem.B.shape[1], r))
    witness = Witness(states=states, disturbances=disturbances)
    least = lbt.hinf(problem, route="riccati").gamma_least
    assert infeasible_level(problem, witness, covariance) <= least * (1 + 1e-9)


def test_states_without_error_prove_nothing():
    """A direction in which no filter errs has no price: a witness that uses it is worth nothing."""
    parts = {"A": np.diag([0.9, 0.5]), "B": [[1, 0], [0, 0]], "C": [[1, 0]], "D": [[0, 1]]}
    p = lbt.EstimationProblem(**parts, L=[[1, 1]])
    free = Witness(states=[[0.0], [1.0]], disturbances=[[1e-6], [0.0]])
    assert not certify_infeasible(p, 1e5, free).passed
    least = lbt.hinf(p, route="riccati").gamma_least
    assert least == pytest.approx(1.34536, abs=1e-5)
    extended = lbt.mixed(p, gamma_ratio=1.01, taps=3).problem
    states, disturbances = np.eye(extended.n_states)[:, -2:], 1e-6 * np.ones((2, 2))
    memory = Witness(states=states, disturbances=disturbances)
    assert not certify_infeasible(extended, 1.1 * least, memory).passed


def test_refusals(axis_plant):
    def certified(*sizes):
        return lambda: infeasible_level(axis_plant, witness(*sizes), np.eye(4))

    def witness(*sizes):
        return Witness(states=np.ones(sizes[0]), disturbances=np.ones(sizes[1]))

    assert witness((1, 4, 1), (1, 3, 1)).states.shape == (4, 1)
    three, nothing = witness((3, 1), (3, 1)), {"states": [[np.nan]], "disturbances": [[1.0]]}
    rows = [
        (lambda: witness(2, 2), DimensionError, "states must be a matrix"),
        (lambda: witness((3, 3), (2, 2)), DimensionError, "must have 3 columns"),
        (lambda: Witness(**nothing), NonFiniteError, "finite"),
        (lambda: witness((2, 4, 1), (4, 1)), DimensionError, "the same phases"),
        (lambda: certify_infeasible(axis_plant, 1.0, three), DimensionError, "4 rows of states"),
        (certified((2, 4, 1), (2, 3, 1)), DimensionError, "period of the problem, 1; got 2"),
    ]
    require_refusals(rows)
