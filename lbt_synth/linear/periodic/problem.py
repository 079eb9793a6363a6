"""The estimation problem of sensors that are not all read in every sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import DefinitenessError, DimensionError
from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.periodic.system import PeriodicSystem
from lbt_synth.validation import BoolArray, FloatArray, frozen_copy, read_only, set_fields


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PeriodicProblem(PeriodicSystem):
    """Estimate ``z = L x`` from past ``y``, of which only some entries are read at each phase.

    ``x(k+1) = A[t] x(k) + B[t] w(k)``, ``y(k) = C[t] x(k) + D[t] w(k)``, with t = k mod N and w
    white noise of unit variance. The filter is the strictly causal one-step predictor.

    Parameters
    ----------
    L : (l, n) array_like
        State to estimated signal.
    read : (N, q) bool array_like
        Which measurements are read at each phase.

    Raises
    ------
    DimensionError
        If sizes clash, or no measurement is ever read.
    DefinitenessError
        If a combination of measurements that are read together is free of noise.

    Examples
    --------
    A walk that a sensor sees in every second sample:

    >>> from lbt_synth.linear.periodic.problem import PeriodicProblem
    >>> seldom = PeriodicProblem(
    ...     A=[[[1.0]]],
    ...     B=[[[1.0, 0.0]]],
    ...     C=[[[1.0]]],
    ...     D=[[[0.0, 1.0]]],
    ...     L=[[1.0]],
    ...     read=[[True], [False]],
    ... )
    >>> seldom.period
    2
    """

    L: FloatArray
    read: BoolArray

    def __post_init__(self) -> None:
        read = np.asarray(self.read, dtype=np.bool_)
        if read.ndim == 2 and len(read) > 1:  # the schedule alone may have the period
            A = np.asarray(self.A, dtype=np.float64)
            if A.ndim == 3 and len(A) == 1:
                set_fields(self, A=np.broadcast_to(A, (len(read), *A.shape[1:])))
        PeriodicSystem.__post_init__(self)
        q, L = self.C.shape[1], np.atleast_2d(np.asarray(self.L, dtype=np.float64))
        if read.shape != (self.period, q) or not read.any():
            raise DimensionError(
                f"read must be {(self.period, q)} truth values, some of them true; got "
                f"{read.shape}."
            )
        if L.shape[1] != self.n_states:
            raise DimensionError(f"L must have {self.n_states} columns; got {L.shape}.")
        set_fields(self, L=frozen_copy(L), read=read_only(read.copy()))
        for t in range(self.period):
            noise = (self.D[t] / self._noise_sizes[t])[read[t]]
            if np.linalg.matrix_rank(noise, tol=1e-9) < len(noise):
                raise DefinitenessError(
                    f"D D' of the measurements read at phase {t} is singular. Every measurement "
                    "needs noise of its own: add a column to D."
                )

    @property
    def n_measurements(self) -> int:
        """Number of measurements q, read or not."""
        return int(self.C.shape[1])

    def parts(self, t: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A, B, and the rows of C and D that are read at a phase."""
        rows = self.read[t]
        return self.A[t], self.B[t], self.C[t][rows], self.D[t][rows]

    def phase(self, t: int) -> EstimationProblem:
        """Return the problem of a phase, with the measurements that are read in it.

        Where nothing is read, there is a measurement of nothing but noise.
        """
        A, B, C, D = self.parts(t)
        if len(C) == 0:
            B, C = np.pad(B, ((0, 0), (0, 1))), np.zeros((1, self.n_states))
            D = np.eye(1, B.shape[1], B.shape[1] - 1)
        return EstimationProblem(A=A, B=B, C=C, D=D, L=self.L, dt_s=self.dt_s)

    def restricted(self, measurements: BoolArray) -> PeriodicProblem:
        """Return the problem without the measurements that are not marked, (q,)."""
        fields = {name: getattr(self, name) for name in ("A", "B", "C", "D", "L", "dt_s")}
        return PeriodicProblem(**fields, read=self.read & measurements)

    def error_system(self, gains: FloatArray) -> PeriodicSystem:
        """System from w to the error ``z - z_hat`` of predictor gains (N, n, q).

        Gains of measurements that are not read count as zero.
        """
        used = np.asarray(gains) * self.read[:, None, :]
        (p, m), N = (len(self.L), self.B.shape[2]), self.period
        return PeriodicSystem(
            A=self.A - used @ self.C,
            B=self.B - used @ self.D,
            C=np.broadcast_to(self.L, (N, *self.L.shape)),
            D=np.zeros((N, p, m)),
            dt_s=self.dt_s,
        )

    @property
    def _noise_sizes(self) -> FloatArray:
        """Noise of each reading (N, q, 1): measurements may have units of very different size."""
        return np.asarray(np.maximum(np.linalg.norm(self.D, axis=2, keepdims=True), 1e-300))
