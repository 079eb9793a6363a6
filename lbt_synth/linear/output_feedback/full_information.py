"""Control with known state and disturbance: the Riccati equation of one side of the problem.

The plant is ``x+ = A x + B1 w + B2 u``, ``z = C1 x + D11 w + D12 u``. The other side, the
estimation of the state, is the same problem with all matrices transposed.

M. Green, D. J. N. Limebeer, "Linear Robust Control", Prentice-Hall (1995), appendix B;
A. A. Stoorvogel, "The H-infinity Control Problem", Prentice-Hall (1992), chapter 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.riccati.dare import solve_dare
from lbt_synth.linear.riccati.equations import Equations, solve_by_doubling, solve_by_schur
from lbt_synth.validation import FloatArray

_ROUNDING = 1e-9  # share of a solution that its residual, or a negative part, may be


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Side:
    """The matrices of one side: of control, or transposed, of estimation."""

    A: FloatArray
    B1: FloatArray
    B2: FloatArray
    C1: FloatArray
    D11: FloatArray
    D12: FloatArray


def control_side(plant: GeneralizedPlant) -> Side:
    """Return the side of a controller that knows state and disturbance."""
    P = plant
    return Side(A=P.A, B1=P.B1, B2=P.B2, C1=P.C1, D11=P.D11, D12=P.D12)


def estimation_side(plant: GeneralizedPlant) -> Side:
    """Return the side of an estimator whose corrections reach state and error, transposed."""
    P = plant
    return Side(A=P.A.T, B1=P.C1.T, B2=P.C2.T, C1=P.B1.T, D11=P.D11.T, D12=P.D21.T)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WorstCase:
    """The loop of best control and worst disturbance at a level, as functions of the state."""

    A: FloatArray  # (n, n), stable
    C: FloatArray  # (p1, n), to the error
    entry: FloatArray  # (n, 1), state that the last, worst disturbance leaves
    error: FloatArray  # (p1, 1), and the error at that instant


class FullInformation:
    """Solves ``X`` of one side for any gamma, as the excess over the least-variance solution.

    With the law of least variance ``u = -feedback x - feedforward w``, what is left is a problem
    without state weight, so that doubling starts inside the reach of the stabilising solution and
    D12 may be singular. Of the side of estimation, transposed, ``weight`` is the covariance of
    the innovation and ``feedback`` its gain into the state.
    """

    def __init__(self, side: Side) -> None:
        A, B1, B2, C1, D11, D12 = (getattr(side, name) for name in _NAMES)
        dare = solve_dare(A, B2, C1.T @ C1, D12.T @ D12, C1.T @ D12)
        self.side, self.least = side, dare.X
        self.weight = D12.T @ D12 + B2.T @ dare.X @ B2
        self.feedback = dare.gain_feedback
        self.feedforward = np.linalg.solve(self.weight, B2.T @ dare.X @ B1 + D12.T @ D11)
        self.A, self.B = A - B2 @ self.feedback, B1 - B2 @ self.feedforward
        C, D = C1 - D12 @ self.feedback, D11 - D12 @ self.feedforward
        self.pushed = D.T @ D + self.B.T @ dare.X @ self.B
        self.cross = self.A.T @ dare.X @ self.B + C.T @ D
        self.reach = np.linalg.solve(np.linalg.cholesky(self.weight), B2.T).T

    def floor(self) -> float:
        """Level that no X can have: that of one step after rest."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.pushed)[-1], 0.0)))

    def solve(self, gamma: float) -> tuple[float, FloatArray | None]:
        """Return the slack of the last step's condition, and X where the slack is above 0.

        Next to the least level X may grow without bound, where doubling loses its digits: the
        ordered Schur form keeps them, and its slack goes on below that level. Where its eigenvalues
        lie on the circle its X solves nothing, and where the equation is ill scaled it has none.
        """
        equation, m = self._equation(gamma), self.B.shape[1]
        if np.linalg.eigvalsh(equation.R[0, :m, :m])[-1] >= 0:
            return -1.0, None
        slack = -1.0
        for route in (solve_by_schur, solve_by_doubling):
            slack, X = self._judge(equation, route(equation)[0], gamma)
            if X is not None:
                return slack, self.least + X
        return slack, None

    def _judge(
        self, equation: Equations, found: FloatArray, gamma: float
    ) -> tuple[float, FloatArray | None]:
        """Return the slack of a solution, and its X if it is one that a controller can have."""
        m, unit = self.B.shape[1], gamma**2 / max(float(np.sum(self.B**2)), 1e-300)
        gains, residual, relative = equation.evaluate(found)
        nothing = float(np.linalg.norm(residual)) < _ROUNDING * unit
        if not (nothing or relative[0] < _ROUNDING):
            return -1.0, None
        if np.max(np.abs(equation.poles(gains))) >= 1:
            return -1.0, None
        weights = equation.weights(found)[0]
        answer = np.linalg.solve(weights[m:, m:], weights[m:, :m])
        slack = -float(np.linalg.eigvalsh(weights[:m, :m] - weights[:m, m:] @ answer)[-1])
        if slack <= 0:
            return slack, None
        sizes = np.linalg.eigvalsh(found[0])
        negative = sizes[0] < -_ROUNDING * max(sizes[-1], unit)
        return (-1.0, None) if negative else (slack, found[0])

    def _equation(self, gamma: float) -> Equations:
        """Return the equation of the excess; disturbances are in units of the level."""
        (n, m), p = self.B.shape, self.reach.shape[1]
        return Equations(
            A=self.A[None],
            B=np.hstack([self.B / gamma, self.reach])[None],
            Q=np.zeros((1, n, n)),
            R=block_diag(self.pushed / gamma**2 - np.eye(m), np.eye(p))[None],
            S=np.hstack([self.cross / gamma, np.zeros((n, p))])[None],
        )

    def refine(self, X: FloatArray, gamma: float) -> FloatArray:
        """Return X after Newton steps on a residual in extended precision."""
        A, B1, B2, C1, D11, D12 = (getattr(self.side, name) for name in _NAMES)
        D = np.hstack([D11, D12])
        R = D.T @ D - block_diag(gamma**2 * np.eye(B1.shape[1]), np.zeros((B2.shape[1],) * 2))
        parts = {"A": A, "B": np.hstack([B1, B2]), "Q": C1.T @ C1, "R": R, "S": C1.T @ D}
        equation = Equations(**{name: part[None] for name, part in parts.items()})
        refined = equation.refine(X[None], np.zeros(1, dtype=np.int64))
        return np.asarray(refined.X[0])

    def worst_case(self, X: FloatArray, gamma: float) -> WorstCase:
        """Return the worst case at a level, for its X."""
        A, B1, B2, C1, D11, D12 = (getattr(self.side, name) for name in _NAMES)
        B, D, m = np.hstack([B1, B2]), np.hstack([D11, D12]), B1.shape[1]
        R = D.T @ D + B.T @ X @ B
        R[:m, :m] -= gamma**2 * np.eye(m)
        law = -np.linalg.solve(R, D.T @ C1 + B.T @ X @ A)
        answer = np.linalg.solve(R[m:, m:], R[m:, :m])
        last = np.linalg.eigh(R[:m, :m] - R[:m, m:] @ answer)[1][:, -1:]
        signals = np.vstack([last, -answer @ last])
        return WorstCase(A=A + B @ law, C=C1 + D @ law, entry=B @ signals, error=D @ signals)


_NAMES = ("A", "B1", "B2", "C1", "D11", "D12")
