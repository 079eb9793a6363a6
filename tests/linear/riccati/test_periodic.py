"""Periodic Riccati equations against the lifted problem, a recursion, and filters of one rate."""

from dataclasses import replace

import numpy as np
import pytest
from support.periodic_problems import lifted_problem, random_periodic_problem, relative_distance
from support.plants import random_problem

import lbt_synth as lbt
from lbt_synth.errors import DetectabilityError, InfeasibleError, NumericalError
from lbt_synth.linear import EstimationProblem, gamma_riccati, infeasible_level, kalman_riccati
from lbt_synth.linear.infeasibility_proof import worst_invisible_disturbance
from lbt_synth.linear.riccati import filtering
from lbt_synth.linear.riccati.filtering import least_gamma


def recursion(problem, periods):
    """Return the covariance of the prediction error after some periods, measurement first."""
    P = np.eye(problem.n_states)
    for k in range(periods * problem.period):
        A, B, C, D = problem.read_parts(k % problem.period)
        innovation, cross = C @ P @ C.T + D @ D.T, A @ P @ C.T + B @ D.T
        P = A @ P @ A.T + B @ B.T - cross @ np.linalg.solve(innovation, cross.T)
        P = (P + P.T) / 2
    return P


def repeated(problem, period):
    """Return a problem with a period of 1 as one with a longer period."""
    parts = {name: np.tile(getattr(problem, name), (period, 1, 1)) for name in "ABCD"}
    return EstimationProblem(**parts, L=problem.L)


def proved(problem, start, solution, level):
    """Return the level that the worst disturbance against a solution proves infeasible."""
    witness = worst_invisible_disturbance(problem, solution.P, level, start.P)
    return infeasible_level(problem, witness, start.P)


@pytest.mark.parametrize("seed", range(24))
def test_kalman_filter_of_the_lifted_problem(seed):
    problem = random_periodic_problem(seed)
    solution = kalman_riccati(problem)
    lifted = kalman_riccati(lifted_problem(problem))
    assert relative_distance(solution.P[0], lifted.P) < 1e-9
    assert not np.any(solution.gain_predictor.transpose(0, 2, 1)[~problem.read])
    assert not np.any(solution.gain_filter.transpose(0, 2, 1)[~problem.read])


@pytest.mark.parametrize("seed", range(0, 24, 3))
def test_kalman_filter_of_a_recursion(seed):
    problem = random_periodic_problem(seed)
    assert relative_distance(kalman_riccati(problem).P[0], recursion(problem, 300)) < 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_covariances_of_all_phases_are_those_of_the_gains(seed):
    problem = random_periodic_problem(seed)
    solution = kalman_riccati(problem)
    assert (
        relative_distance(problem.error_system(solution.gain_predictor).covariances(), solution.P)
        < 1e-9
    )


@pytest.mark.parametrize("seed", range(6))
def test_the_gain_of_the_measurement_update_without_correlation(seed):
    """Then the predictor's gain is that of the filter, and a step of the plant."""
    problem = random_periodic_problem(seed)
    q = problem.n_measurements
    alone = replace(problem, B=problem.B * (np.arange(problem.B.shape[-1]) < problem.n_states))
    noise = problem.D * (np.arange(problem.D.shape[-1]) >= problem.D.shape[-1] - q)
    alone = replace(alone, D=noise)
    start = kalman_riccati(alone)
    high = lbt.hinf_norm(alone.error_system(start.gain_predictor)).upper
    for solution in (start, gamma_riccati(alone, 1.2 * high, start=start)):
        assert relative_distance(alone.A @ solution.gain_filter, solution.gain_predictor) < 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_hinf_of_matrices_that_repeat(seed):
    one = random_problem(np.random.default_rng(seed), 4, 2, l=2)
    expected = lbt.hinf(one, route="riccati")
    problem = repeated(one, 3)
    start = kalman_riccati(problem)
    upper = lbt.hinf_norm(one.error_system(start.gain_predictor[0])).upper
    low, high, solution = least_gamma(problem, lower=0.0, upper=upper, start=start)
    assert high * (1 - 1e-9) <= low <= high
    assert high * (1 - 1e-6) < proved(problem, start, solution, high) <= high
    assert high == pytest.approx(expected.gamma_least, rel=1e-8)
    central, single = gamma_riccati(problem, 1.1 * high), gamma_riccati(one, 1.1 * high)
    for t in range(3):
        assert relative_distance(central.gain_predictor[t], single.gain_predictor) < 1e-7
        assert relative_distance(central.gain_filter[t], single.gain_filter) < 1e-7


@pytest.mark.parametrize("seed", range(0, 24, 4))
def test_the_error_of_an_hinf_filter_is_below_its_level(seed):
    problem = random_periodic_problem(seed)
    start = kalman_riccati(problem)
    kalman = lbt.hinf_norm(problem.error_system(start.gain_predictor)).upper
    _, least, solution = least_gamma(problem, lower=0.0, upper=kalman)
    assert 0.99 * least < proved(problem, start, solution, least) <= least
    assert least <= kalman * (1 + 1e-9)
    for level in (1.001 * least, 1.3 * least):
        found = gamma_riccati(problem, level, start=start)
        assert lbt.hinf_norm(problem.error_system(found.gain_predictor)).value < level
    assert gamma_riccati(problem, 0.999 * least, start=start) is None
    # far above the least level it is the Kalman filter
    far = gamma_riccati(problem, 1e6 * least).gain_predictor
    assert relative_distance(far, start.gain_predictor) < 1e-9


def walk(**changes):
    parts = {"A": [[[1.0]]], "B": [[[1.0, 0.0]]], "C": [[[1.0]]], "D": [[[0.0, 1.0]]]}
    return EstimationProblem(**(parts | changes), L=[[1.0]], read=[[True], [False]])


def test_a_walk_that_is_read_in_every_second_sample():
    # P0 = P + 1 and P = P0 / (1 + P0) + 1: P0^2 - 2 P0 - 2 = 0
    P = kalman_riccati(walk()).P.ravel()
    assert P == pytest.approx([1 + np.sqrt(3), np.sqrt(3)], rel=1e-12)


def test_a_mode_that_no_reading_sees():
    parts = {"A": [np.diag([1.1, 0.5])], "B": [np.eye(2, 3)], "L": [[1.0, 0.0]]}
    hidden = EstimationProblem(
        **parts, C=[[[0.0, 1.0]]], D=[[[0.0, 0.0, 1.0]]], read=[[True], [False]]
    )
    with pytest.raises(DetectabilityError, match=r"1\.21.*no measurement sees it"):
        kalman_riccati(hidden)


def test_a_walk_that_nothing_drives():
    with pytest.raises(DetectabilityError, match="driven by noise"):
        kalman_riccati(walk(B=[[[0.0, 0.0]]]))


def test_an_equation_that_is_not_solved(monkeypatch):
    monkeypatch.setattr(filtering, "ERROR_LIMIT", -1.0)
    with pytest.raises(NumericalError, match="solved only to a relative"):
        kalman_riccati(walk())


def test_a_level_that_is_not_met_is_no_upper_bound():
    problem = walk()
    with pytest.raises(InfeasibleError, match="no gamma up to"):
        least_gamma(problem, lower=0.0, upper=0.1)
