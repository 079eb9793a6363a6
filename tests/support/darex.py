"""Examples of DAREX that have a known solution.

P. Benner, A. J. Laub, V. Mehrmann, "A collection of benchmark examples for the numerical
solution of algebraic Riccati equations II: discrete-time case", report SPC 95_23, TU
Chemnitz-Zwickau (1995); numbers of version 2.0 (J. Abels, P. Benner, SLICOT working note
1999-16), as in SLICOT's BB02AD.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import slycot


@dataclass(frozen=True, kw_only=True)
class Example:
    name: str
    A: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    X: np.ndarray


def _example(name, A, B, Q, R, X):
    return Example(
        name=name,
        **{k: np.array(v, dtype=float) for k, v in zip("ABQRX", (A, B, Q, R, X), strict=True)},
    )


def example_2_1(delta):
    Q = np.array([[9.0, 6.0], [6.0, 4.0]])
    X = (1 + np.sqrt(1 + 4 * delta)) / 2 * Q
    return _example(f"2.1 delta={delta:g}", [[4, 3], [-4.5, -3.5]], [[1], [-1]], Q, [[delta]], X)


def example_2_3(epsilon):
    return _example(
        f"2.3 epsilon={epsilon:g}",
        [[0, epsilon], [0, 0]],
        [[0], [1]],
        np.eye(2),
        [[1]],
        np.diag([1, 1 + epsilon**2]),
    )


def example_2_4(epsilon):
    V = np.eye(3) - 2 / 3
    A = np.array([[16.0, 10, -2], [10, 13, -8], [-2, -8, 7]]) / 9  # V diag(0, 1, 3) V
    X = epsilon * V @ np.diag([1, (1 + np.sqrt(5)) / 2, (9 + np.sqrt(85)) / 2]) @ V
    return _example(
        f"2.4 epsilon={epsilon:g}", A, np.eye(3), epsilon * np.eye(3), epsilon * np.eye(3), X
    )


def example_2_5(tau):
    alpha, beta, r = 1 - 1 / tau, 1 / tau, 0.25
    A = np.eye(4, k=-1)
    A[0, 0] = alpha
    t = r * (alpha + 1) * (alpha - 1) + beta**2
    x = (t + np.sqrt(t * t + 4 * beta**2 * r)) / 2 / beta**2
    return _example(
        f"2.5 tau={tau:g}",
        A,
        [[beta], [0], [0], [0]],
        np.diag([0, 0, 0, 1]),
        [[r]],
        np.diag([x, 1, 1, 1]),
    )


# 1.4 is printed with A[1, 2] = 0.01 and X[2, 2] = 0, which do not fit each other: with that A
# the solution has X[2, 2] = -9.9, with A[1, 2] = 0.1 it is 0. Both are here.
EXAMPLES = (
    _example("1.1", [[2, -1], [1, 0]], [[1], [0]], np.diag([0, 1]), [[0]], np.eye(2)),
    _example(
        "1.3", [[0, 1], [0, 0]], [[0], [1]], [[1, 2], [2, 4]], [[1]], [[1, 2], [2, 2 + np.sqrt(5)]]
    ),
    _example(
        "1.4 A=0.01",
        [[0, 0.1, 0], [0, 0, 0.01], [0, 0, 0]],
        [[1, 0], [0, 0], [0, 1]],
        np.diag([1e5, 1e3, -10]),
        np.diag([0, 1]),
        np.diag([1e5, 1e3, -9.9]),
    ),
    _example(
        "1.4 A=0.1",
        [[0, 0.1, 0], [0, 0, 0.1], [0, 0, 0]],
        [[1, 0], [0, 0], [0, 1]],
        np.diag([1e5, 1e3, -10]),
        np.diag([0, 1]),
        np.diag([1e5, 1e3, 0]),
    ),
    *(example_2_1(delta) for delta in (1e6, 1e-6, 1.0, 1e10)),
    *(example_2_3(epsilon) for epsilon in (1e6, 1e3, 1.0)),
    *(example_2_4(epsilon) for epsilon in (1e6, 1.0, 1e-6)),
    *(example_2_5(tau) for tau in (1e8, 1e6, 1e4)),
    _example(
        "4.1 n=100",
        np.eye(100, k=1),
        np.eye(100)[:, -1:],
        np.eye(100),
        [[1]],
        np.diag(np.arange(1.0, 101)),
    ),
)


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
