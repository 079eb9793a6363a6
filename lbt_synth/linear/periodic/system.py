"""Periodic linear systems: their monodromy, their variances, and their system over a period.

S. Bittanti, P. Colaneri, "Periodic Systems: Filtering and Control", Springer (2009),
doi:10.1007/978-1-84800-911-0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.matrix_functions import complex_schur
from lbt_synth.linear.state_space import Controller, StateSpace
from lbt_synth.validation import ComplexArray, FloatArray, number, real_array, set_fields

_CHUNK = 2_000_000  # complex numbers that a frequency response computes at once


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PeriodicSystem:
    """System ``x(k+1) = A[t] x(k) + B[t] w(k)``, ``y(k) = C[t] x(k) + D[t] w(k)``, t = k mod N."""

    A: FloatArray  # (N, n, n): matrices of each phase; those of one phase, (1, ...), are repeated
    B: FloatArray
    C: FloatArray
    D: FloatArray
    dt_s: float = 1.0  # sampling period [s]

    def __post_init__(self) -> None:
        parts = {name: real_array(getattr(self, name), name) for name in "ABCD"}
        for name, part in parts.items():
            if part.ndim != 3:
                raise DimensionError(f"{name} must be a matrix per phase; got {part.shape}.")
        period = max(len(part) for part in parts.values())
        n, m, p = parts["A"].shape[2], parts["B"].shape[2], parts["C"].shape[1]
        sizes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m)}
        for name, part in parts.items():
            if part.shape[1:] != sizes[name] or len(part) not in (1, period):
                raise DimensionError(f"{name} must be {(period, *sizes[name])}; got {part.shape}.")
            parts[name] = np.broadcast_to(part, (period, *sizes[name]))
        set_fields(self, **parts, dt_s=number(self.dt_s, "dt_s", above=0))

    @property
    def period(self) -> int:
        """Number of phases N."""
        return len(self.A)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.A.shape[1])

    @property
    def monodromy(self) -> FloatArray:
        """Transition over a period, from phase 0 to the next phase 0, (n, n)."""
        out = np.eye(self.n_states)
        for A in self.A:
            out = A @ out
        return out

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of the eigenvalues of the monodromy: of a period, not of a frame."""
        return float(np.max(np.abs(np.linalg.eigvals(self.monodromy)), initial=0.0))

    @property
    def radius_per_frame(self) -> float:
        """The spectral radius of a period as a factor per frame."""
        return float(self.spectral_radius ** (1 / self.period))

    def lifted(self) -> StateSpace:
        """Return the system over a period: inputs and outputs of all phases side by side."""
        (N, p, m), n = self.D.shape, self.n_states
        reach, inputs = np.eye(n), np.zeros((n, N * m))
        C, D = np.zeros((N * p, n)), np.zeros((N * p, N * m))
        for t in range(N):
            rows, own = slice(t * p, (t + 1) * p), slice(t * m, (t + 1) * m)
            C[rows], D[rows] = self.C[t] @ reach, self.C[t] @ inputs
            D[rows, own] = self.D[t]
            reach, inputs = self.A[t] @ reach, self.A[t] @ inputs
            inputs[:, own] = self.B[t]
        return StateSpace(A=reach, B=inputs, C=C, D=D, dt_s=N * self.dt_s)

    def lifted_compactly(self) -> StateSpace:
        """Return the lifted system with its inputs turned so that few remain.

        Norm and variances are the same, as white noise is turned to white noise.
        """
        system = self.lifted()
        turned = np.linalg.qr(np.vstack([system.B, system.D]).T)[1].T
        return replace(system, B=turned[: self.n_states], D=turned[self.n_states :])

    def covariances(self) -> FloatArray:
        """Return the stationary covariance of x at each phase, for white w of unit variance."""
        drives = self.B @ self.B.transpose(0, 2, 1)
        whole = np.zeros_like(drives[0])  # of what a period adds
        for A, drive in zip(self.A, drives, strict=True):
            whole = A @ whole @ A.T + drive
        out, P = np.empty_like(self.A), stationary_covariance(self.monodromy, whole)
        for t in range(self.period):
            out[t] = P
            P = self.A[t] @ P @ self.A[t].T + drives[t]
        return out

    def output_covariances(self) -> FloatArray:
        """Return the stationary covariance of y at each phase, for white w, (N, p, p)."""
        swap = (0, 2, 1)
        state = self.C @ self.covariances() @ self.C.transpose(swap)
        return np.asarray(state + self.D @ self.D.transpose(swap))

    def frequency_response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Complex amplitude of y at each phase for the input ``exp(2 pi i f k dt)``, (f, N, p, m).

        The output is this amplitude times the input's own ``exp``: for one phase it is the
        transfer matrix. Its mean square over the phases is the mean power of the output.
        """
        frequency = np.atleast_1d(real_array(frequency_hz, "frequency_hz"))
        z = np.exp(2j * np.pi * frequency * self.dt_s)
        (N, p, m), whole = self.D.shape, self.lifted()
        schur = complex_schur(whole.A)
        step = max(1, _CHUNK // (N * max(p, self.n_states)))
        out = np.empty((z.size, N, p, m), dtype=np.complex128)
        for j in range(m):  # the input of a period is one of its columns times z^0, z^1, ...
            own = replace(whole, B=whole.B[:, j::m], D=whole.D[:, j::m])
            for start in range(0, z.size, step):
                part = slice(start, start + step)
                out[part, :, :, j] = _repeating_response(own, schur, z[part], N)
        return out


def _repeating_response(
    whole: StateSpace, schur: tuple[ComplexArray, ComplexArray], z: ComplexArray, N: int
) -> ComplexArray:
    """Return y(t) z^-t of each phase for the input z^k of a system over a period, (f, N, p)."""
    T, U = schur
    turns = z[:, None] ** np.arange(N)
    x = (turns @ whole.B.T) @ U.conj()  # the state at phase 0 repeats as z^N: solve for it
    for i in range(whole.n_states - 1, -1, -1):
        x[:, i] = (x[:, i] + x[:, i + 1 :] @ T[i, i + 1 :]) / (z**N - T[i, i])
    out = (x @ U.T) @ whole.C.T + turns @ whole.D.T
    return np.asarray(out.reshape(len(z), N, -1) / turns[:, :, None])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PeriodicController(PeriodicSystem):
    """Controller ``x(k+1) = A[t] x(k) + B[t] y(k)``, ``u(k) = C[t] x(k+1) + D[t] y(k)``.

    The output is read from the new state, as in :class:`Controller`, which is the case N = 1.
    """

    def phase(self, t: int) -> Controller:
        """Return the controller of a phase, as if it were that of all."""
        A, B, C, D = (getattr(self, name)[t % self.period] for name in "ABCD")
        return Controller(A=A, B=B, C=C, D=D, dt_s=self.dt_s)

    def to_statespace(self) -> PeriodicSystem:
        """Return the same input-output map in the textbook form."""
        return PeriodicSystem(
            A=self.A, B=self.B, C=self.C @ self.A, D=self.C @ self.B + self.D, dt_s=self.dt_s
        )
