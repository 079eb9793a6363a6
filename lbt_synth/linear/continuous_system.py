"""Systems in continuous time, and the bilinear map between them and discrete time.

With ``s = rate (z - 1) / (z + 1)`` the imaginary axis becomes the unit circle: a stable system
stays stable, and the H-infinity norm stays what it is. The H2 norm does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import matrix_balance

from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.linear.other_systems import control_system, system_parts
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.storage.summaries import Summarised
from lbt_synth.storage.words import count_text
from lbt_synth.validation import ComplexArray, FloatArray, matrix, real_array, set_fields, square

_SINGULAR = 1e-13  # reciprocal condition at which a point counts as a pole


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContinuousSystem(Summarised):
    """Continuous-time system ``dx/dt = A x + B u``, ``y = C x + D u``; time in seconds.

    Parameters
    ----------
    A, B, C, D : array_like
        Matrices (n, n), (n, m), (p, n), (p, m).

    Raises
    ------
    ProblemError
        If a matrix is not finite or the sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lag = lbt.linear.ContinuousSystem(A=[[-1.0]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    >>> round(float(lbt.hinf_norm(lag.to_discrete(rate=3.0))), 9)  # the norm stays
    1.0
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    def __post_init__(self) -> None:
        A = square(self.A, "A")
        B = matrix(self.B, "B", rows=(len(A), f"to match A {A.shape}"))
        C = matrix(self.C, "C", cols=(len(A), f"to match A {A.shape}"))
        rows, cols = (len(C), f"to match C {C.shape}"), (B.shape[1], f"to match B {B.shape}")
        set_fields(self, A=A, B=B, C=C, D=matrix(self.D, "D", rows=rows, cols=cols))

    def _brief(self) -> str:
        sizes = zip((len(self.A), *self.D.shape[::-1]), ("state", "input", "output"), strict=True)
        return ", ".join(count_text(*size) for size in sizes) + ", continuous time"

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues of A [1/s], (n,)."""
        return np.linalg.eigvals(self.A).astype(np.complex128)

    def frequency_response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Transfer matrices ``D + C (2 pi j f I - A)^-1 B`` at frequencies [Hz], (f, p, m)."""
        frequency = np.atleast_1d(real_array(frequency_hz, "frequency_hz"))
        s = 2j * np.pi * frequency[:, None, None]
        entry = np.broadcast_to(self.B, (frequency.size, *self.B.shape)).astype(np.complex128)
        solved = np.linalg.solve(s * np.eye(len(self.A)) - self.A, entry)
        return np.asarray(self.C @ solved + self.D, dtype=np.complex128)

    def to_control(self) -> Any:
        """Return the system as a continuous ``control.StateSpace``."""
        return control_system(self.A, self.B, self.C, self.D, None)

    def to_discrete(self, rate: float) -> StateSpace:
        """Map to discrete time with ``s = rate (z - 1) / (z + 1)``; rate [1/s].

        The sampling period of the result is that at which slow signals keep their frequency,
        ``2 / rate``. A pole at ``s = rate`` raises a NumericalError.
        """
        A, B, C, D = _bilinear(self.A, self.B, self.C, self.D, rate)
        return StateSpace(A=A, B=B, C=C, D=D, dt_s=2 / rate)

    @classmethod
    def from_discrete(cls, system: StateSpace, rate: float) -> ContinuousSystem:
        """Map a discrete system back; one with a pole at ``z = -1`` raises a NumericalError."""
        A, B, C, units = _balance(system.A, system.B, system.C)
        one = np.eye(system.n_states)
        middle = one + A
        if np.linalg.cond(middle) > 1 / _SINGULAR:
            raise NumericalError(
                "the system has a pole at z = -1, which is an infinite one in continuous time. "
                "Try a larger gamma_ratio, or give every control and measurement a weight.",
                status="improper",
            )
        back = _solve(middle, np.hstack([A - one, B]))
        leaving = _solve(middle.T, C.T).T
        n, scale = system.n_states, math.sqrt(2 * rate)
        return cls(
            A=rate * units[:, None] * back[:, :n] / units,
            B=scale * units[:, None] * back[:, n:],
            C=scale * leaving / units,
            D=system.D - C @ back[:, n:],
        )


def _bilinear(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, rate: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    A, B, C, units = _balance(A, B, C)
    one = np.eye(len(A))
    middle = rate * one - A
    if np.linalg.cond(middle) > 1 / _SINGULAR:
        raise NumericalError(
            f"the system has a pole at {rate:.9g} 1/s, where the bilinear map has none. Try "
            "another rate.",
            status="bilinear",
        )
    solved = _solve(middle, np.hstack([rate * one + A, B]))
    leaving = _solve(middle.T, C.T).T
    n = len(A)
    scale = math.sqrt(2 * rate)
    discrete = units[:, None] * solved[:, :n] / units
    entry, exit_ = scale * units[:, None] * solved[:, n:], scale * leaving / units
    return discrete, entry, exit_, D + C @ solved[:, n:]


def _balance(
    A: FloatArray, B: FloatArray, C: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B and C in balanced units of the states, and these units, powers of two (n,)."""
    balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
    scale = np.asarray(units, dtype=np.float64)
    return np.asarray(balanced, dtype=np.float64), B / scale[:, None], C * scale, scale


def _solve(M: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(M, right), dtype=np.float64)


def linear_system(system: Any) -> StateSpace | ContinuousSystem:
    """Take a system in discrete or continuous time, from here, python-control or scipy.

    Parameters
    ----------
    system : object
        A StateSpace, a ContinuousSystem, a system of python-control or of ``scipy.signal`` in
        any form, or a tuple (A, B, C, D), which is in discrete time.

    Returns
    -------
    StateSpace or ContinuousSystem
        The system.

    Raises
    ------
    ProblemError
        If it is no linear system.

    Examples
    --------
    >>> import scipy.signal
    >>> import lbt_synth as lbt
    >>> lbt.linear.linear_system(scipy.signal.TransferFunction([1.0], [1.0, 2.0]))
    <ContinuousSystem: 1 state, 1 input, 1 output, continuous time>
    """
    if isinstance(system, StateSpace | ContinuousSystem):
        return system
    A, B, C, D, dt_s = system_parts(system)
    if dt_s is None:
        return ContinuousSystem(A=A, B=B, C=C, D=D)
    return StateSpace(A=A, B=B, C=C, D=D, dt_s=dt_s)


def require_same_time(*systems: StateSpace | ContinuousSystem) -> float | None:
    """Return the sampling period that systems share, None in continuous time; else refuse."""
    periods = {s.dt_s if isinstance(s, StateSpace) else None for s in systems}
    if len(periods) > 1:
        listed = ", ".join("continuous" if p is None else f"{p:.6g} s" for p in periods)
        raise ProblemError(
            f"all systems must be in the same time, with one sampling period; got {listed}."
        )
    return periods.pop()
