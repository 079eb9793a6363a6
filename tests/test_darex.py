"""The DAREX examples with known solutions, beside scipy and SLICOT."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import scipy.linalg
import slycot
from support.darex import EXAMPLES, example_2_1, example_2_4

import lbt_synth as lbt

ROUNDING = np.finfo(float).eps


def relative(X, exact):
    return np.linalg.norm(X - exact) / np.linalg.norm(exact)


def peers(e):
    """Answers of scipy and SLICOT, those that they give."""
    answers = {}
    for name, call in (
        ("scipy", lambda: scipy.linalg.solve_discrete_are(e.A, e.B, e.Q, e.R)),
        ("slycot", lambda: slycot.sb02od(len(e.A), e.B.shape[1], e.A, e.B, e.Q, e.R, "D")[0]),
    ):
        try:
            with np.errstate(all="ignore"):
                answers[name] = call()
        except (np.linalg.LinAlgError, ValueError, ArithmeticError):
            continue
    return answers


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda e: e.name)
def test_known_solutions(example):
    """Never worse than ten times the better of the peers, nor than rounding."""
    solution = lbt.solve_dare(example.A, example.B, example.Q, example.R)
    error = relative(solution.X, example.X)
    best = min(relative(X, example.X) for X in peers(example).values())
    assert error <= 10 * max(best, ROUNDING)
    assert error < 1e-12
    assert np.max(np.abs(solution.poles)) < 1


def exact_solution(e):
    """Newton's method with 40 digits on the data as they are in double precision."""
    with mpmath.workdps(40):
        A, B, Q, R, X = (mpmath.matrix(M.tolist()) for M in (e.A, e.B, e.Q, e.R, e.X))
        for _ in range(6):
            gain = mpmath.inverse(R + B.T * X * B) * (B.T * X * A)
            power = A - B * gain
            X = Q + gain.T * R * gain
            for _ in range(60):
                X, power = X + power.T * X * power, power * power
        return X


def error_in_digits(X, exact):
    with mpmath.workdps(40):
        difference = mpmath.matrix(X.tolist()) - exact
        return float(mpmath.sqrt(sum(x * x for x in difference) / sum(x * x for x in exact)))


@pytest.mark.parametrize("example", [example_2_1(1e6), example_2_4(1e6)], ids=lambda e: e.name)
def test_ten_times_better_than_the_peers(example):
    """Against the exact solution of the rounded data: the printed one is only as good as those."""
    exact = exact_solution(example)
    ours = error_in_digits(lbt.solve_dare(example.A, example.B, example.Q, example.R).X, exact)
    best = min(error_in_digits(X, exact) for X in peers(example).values())
    assert 10 * ours <= best
