"""Periodic Riccati equations against the lifted problem, a recursion, and filters of one rate."""

import numpy as np
import pytest
from support.periodic_problems import lifted_problem, random_periodic_problem, relative_distance
from support.plants import random_problem

import lbt_synth as lbt
from lbt_synth.errors import DetectabilityError, InfeasibleError, NumericalError
from lbt_synth.linear import PeriodicProblem, periodic_kalman
from lbt_synth.linear.periodic import riccati
from lbt_synth.linear.periodic.riccati import periodic_hinf


def recursion(problem, periods):
    """Return the covariance of the prediction error after some periods, measurement first."""
    P = np.eye(problem.n_states)
    for k in range(periods * problem.period):
        A, B, C, D = problem.parts(k % problem.period)
        innovation, cross = C @ P @ C.T + D @ D.T, A @ P @ C.T + B @ D.T
        P = A @ P @ A.T + B @ B.T - cross @ np.linalg.solve(innovation, cross.T)
        P = (P + P.T) / 2
    return P


def of_one_rate(problem, period=1):
    """Return a problem of one rate as a periodic one."""
    parts = {name: np.tile(getattr(problem, name), (period, 1, 1)) for name in "ABCD"}
    return PeriodicProblem(**parts, L=problem.L, read=np.ones((period, len(problem.C)), np.bool_))


@pytest.mark.parametrize("seed", range(24))
def test_kalman_filter_of_the_lifted_problem(seed):
    problem = random_periodic_problem(seed)
    solution = periodic_kalman(problem)
    lifted = lbt.linear.kalman_riccati(lifted_problem(problem))
    assert relative_distance(solution.P[0], lifted.P) < 1e-9
    assert not np.any(solution.gains.transpose(0, 2, 1)[~problem.read])


@pytest.mark.parametrize("seed", range(0, 24, 3))
def test_kalman_filter_of_a_recursion(seed):
    problem = random_periodic_problem(seed)
    assert relative_distance(periodic_kalman(problem).P[0], recursion(problem, 300)) < 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_covariances_of_all_phases_are_those_of_the_gains(seed):
    problem = random_periodic_problem(seed)
    solution = periodic_kalman(problem)
    assert relative_distance(problem.error_system(solution.gains).covariances(), solution.P) < 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_hinf_of_one_rate(seed):
    one = random_problem(np.random.default_rng(seed), 4, 2, l=2)
    expected = lbt.hinf(one, route="riccati")
    for period in (1, 3):
        problem = of_one_rate(one, period)
        start = periodic_kalman(problem)
        upper = lbt.hinf_norm(one.error_system(start.gains[0])).upper
        high = riccati.least_periodic_gamma(problem, start, upper)
        assert high * (1 - 1e-6) < riccati.proved_periodic_gamma(problem, start, high) <= high
        assert high == pytest.approx(expected.gamma_least, rel=1e-8)
        central = periodic_hinf(problem, 1.1 * high, start)
        gain = lbt.linear.gamma_riccati(one, 1.1 * high).gain_predictor
        for own in central.gains:
            assert relative_distance(own, gain) < 1e-7


@pytest.mark.parametrize("seed", range(0, 24, 4))
def test_the_error_of_an_hinf_filter_is_below_its_level(seed):
    problem = random_periodic_problem(seed)
    start = periodic_kalman(problem)
    kalman = lbt.hinf_norm(problem.error_system(start.gains).lifted()).upper
    least = riccati.least_periodic_gamma(problem, start, kalman)
    assert 0.99 * least < riccati.proved_periodic_gamma(problem, start, least) <= least
    assert riccati.proved_periodic_gamma(problem, start, 0.99 * least) == 0
    assert least <= kalman * (1 + 1e-9)
    for level in (1.001 * least, 1.3 * least):
        found = periodic_hinf(problem, level, start)
        assert lbt.hinf_norm(problem.error_system(found.gains).lifted()).value < level
    assert periodic_hinf(problem, 0.999 * least, start) is None
    # far above the least level it is the Kalman filter
    assert relative_distance(periodic_hinf(problem, 1e6 * least, start).gains, start.gains) < 1e-9


def walk(**changes):
    parts = {"A": [[[1.0]]], "B": [[[1.0, 0.0]]], "C": [[[1.0]]], "D": [[[0.0, 1.0]]]}
    return PeriodicProblem(**(parts | changes), L=[[1.0]], read=[[True], [False]])


def test_a_walk_that_is_read_in_every_second_sample():
    # P0 = P + 1 and P = P0 / (1 + P0) + 1: P0^2 - 2 P0 - 2 = 0
    P = periodic_kalman(walk()).P.ravel()
    assert P == pytest.approx([1 + np.sqrt(3), np.sqrt(3)], rel=1e-12)


def test_a_mode_that_no_reading_sees():
    parts = {"A": [np.diag([1.1, 0.5])], "B": [np.eye(2, 3)], "L": [[1.0, 0.0]]}
    hidden = PeriodicProblem(
        **parts, C=[[[0.0, 1.0]]], D=[[[0.0, 0.0, 1.0]]], read=[[True], [False]]
    )
    with pytest.raises(DetectabilityError, match=r"1\.21.*no measurement sees it"):
        periodic_kalman(hidden)


def test_a_walk_that_nothing_drives():
    with pytest.raises(DetectabilityError, match="driven by noise"):
        periodic_kalman(walk(B=[[[0.0, 0.0]]]))


def test_an_equation_that_is_not_solved(monkeypatch):
    monkeypatch.setattr(riccati, "_CLOSED", -1.0)
    with pytest.raises(NumericalError, match="solved only to a relative"):
        periodic_kalman(walk())
    monkeypatch.setattr(riccati, "fixed_point", lambda triple: np.full((1, 1), np.nan))
    with pytest.raises(NumericalError, match="did not converge"):
        periodic_kalman(walk())


def test_a_level_that_is_not_met_is_no_upper_bound():
    problem = walk()
    with pytest.raises(InfeasibleError, match="no gamma up to"):
        riccati.least_periodic_gamma(problem, periodic_kalman(problem), 0.1)
