"""The estimation problem that every filter in this package solves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import DefinitenessError, DimensionError, NonFiniteError, ProblemError
from lbt_synth.linear.controller import Controller
from lbt_synth.linear.matrix_functions import nearest_powers_of_two, transpose
from lbt_synth.linear.state_space import LinearSystem, StateSpace
from lbt_synth.validation import (
    BoolArray,
    FloatArray,
    frozen_copy,
    integer,
    matrix,
    read_only,
    set_fields,
)

LONGEST_HORIZON = 100  # samples
_EXTREME = 1e75  # of an entry, and one over a noise: products of four of them are numbers
_NOISE_FREE = 1e-9  # singular value of readings whose noise is of size one that counts as zero


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EstimationProblem(LinearSystem):
    """Estimate ``z = L x`` from past ``y``, where ``x+ = A x + B w`` and ``y = C x + D w``.

    The filter is the strictly causal one-step predictor: the estimate of z(k)
    uses y up to k-1. For the Kalman filter w is white noise of unit variance,
    for the H-infinity filter any signal of unit energy; B and D hold the
    weights. B D' need not be zero.

    Each matrix but L may be a stack of one matrix per phase, such as (N, n, n): the sample k has
    those of the phase k mod N. Not all measurements need be read in every phase.

    Parameters
    ----------
    A : (n, n) or (N, n, n) array_like
        State matrix.
    B : (n, p) or (N, n, p) array_like
        Disturbance to state.
    C : (q, n) or (N, q, n) array_like
        State to measurement.
    D : (q, p) or (N, q, p) array_like
        Disturbance to measurement; ``D D'`` must be positive definite over what is read together.
    L : (l, n) array_like
        State to the signal that is estimated.
    read : (N, q) bool array_like, optional
        Which measurements are read at each phase; by default all. It alone may have the period.
    dt_s : float, optional
        Sampling period [s]; 1 when the samples have no physical rate.

    Raises
    ------
    DimensionError
        If sizes clash, or no measurement is ever read.
    NonFiniteError
        If an entry is NaN or infinite, or above 1e75.
    DefinitenessError
        If ``D D'`` is singular: some combination of measurements is free of noise.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> walk = lbt.EstimationProblem(
    ...     A=[[1.0]], B=[[1.0, 0.0]], C=[[1.0]], D=[[0.0, 1.0]], L=[[1.0]]
    ... )
    >>> round(lbt.kalman(walk).rms ** 2, 6)  # the golden ratio
    1.618034
    """

    L: FloatArray
    read: BoolArray = field(default=None)  # type: ignore[arg-type]  # (N, q)

    def __post_init__(self) -> None:
        LinearSystem.__post_init__(self)
        if not self.n_states:
            raise DimensionError("a problem without states has nothing to estimate; got A (0, 0).")
        L = matrix(self.L, "L", cols=(self.n_states, f"to match A {self.A.shape}"))
        q = self.n_measurements
        if not q or not len(L):
            raise DimensionError(
                "a problem needs something measured and something to estimate; got C with "
                f"{q} rows and L with {len(L)}."
            )
        given = np.full((1, q), True) if self.read is None else self.read
        read = np.array(given, dtype=np.bool_, ndmin=2)
        if len(read) > 1:  # the schedule alone may have the period
            self._set_phases(len(read), A=self.A, B=self.B, C=self.C, D=self.D)
        if read.shape not in ((1, q), (self.period, q)) or not read.any():
            raise DimensionError(
                f"read must be {(self.period, q)} truth values, some of them true; got "
                f"{read.shape}."
            )
        read = np.broadcast_to(read, (self.period, q)).copy()
        set_fields(self, L=L, read=read_only(read))
        self._require_computable()

    def _require_computable(self) -> None:
        """Refuse entries beyond all units, and readings with a combination free of noise."""
        for name in "ABCDL":
            if (most := np.max(np.abs(getattr(self, name)), initial=0.0)) > _EXTREME:
                raise NonFiniteError(f"{name} must be within {_EXTREME:g}; got {most:g}. Scale it.")
        for t in range(self.period):
            D = self.read_parts(t)[3]
            sizes = np.maximum(np.linalg.norm(D, axis=1, keepdims=True), 1 / _EXTREME)
            if np.linalg.matrix_rank(D / sizes, tol=_NOISE_FREE) < len(D):
                where = f" at phase {t}" if self.period > 1 else ""
                raise DefinitenessError(
                    f"D D' of the measurements read{where} is singular. Every measurement needs "
                    "noise of its own: add a column to D."
                )

    @property
    def n_measurements(self) -> int:
        """Number of measurements q, read or not."""
        return int(self.C.shape[-2])

    @property
    def reads_all(self) -> bool:
        """Whether every measurement is read in every sample, by the same matrices."""
        return self.period == 1 and bool(self.read.all())

    @property
    def Q(self) -> FloatArray:
        """Covariance of the process noise, ``B B'`` (n, n) or (N, n, n)."""
        return frozen_copy(self.B @ transpose(self.B))

    @property
    def R(self) -> FloatArray:
        """Covariance of the measurement noise, ``D D'`` (q, q) or (N, q, q)."""
        return frozen_copy(self.D @ transpose(self.D))

    @property
    def S(self) -> FloatArray:
        """Cross-covariance of process and measurement noise, ``B D'`` (n, q) or (N, n, q)."""
        return frozen_copy(self.B @ transpose(self.D))

    def read_parts(self, t: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A, B, and the rows of C and D that are read at a phase, t mod N."""
        phase = t % self.period
        A, B, C, D = (stack[phase] for stack in self.stacks())
        rows = self.read[phase]
        return (A, B, C, D) if rows.all() else (A, B, C[rows], D[rows])

    def bare(self, **changes: Any) -> EstimationProblem:
        """Return the problem of these matrices alone, with some of them changed."""
        names = ("A", "B", "C", "D", "L", "read", "dt_s")
        return EstimationProblem(**{name: getattr(self, name) for name in names} | changes)

    def restricted(self, measurements: BoolArray) -> EstimationProblem:
        """Return the problem without the measurements that are not marked, (q,)."""
        return self.bare(read=self.read & measurements)

    def error_system(self, gain_predictor: FloatArray) -> StateSpace:
        """System ``(A - gain C, B - gain D, L, 0)`` from w to a predictor's error ``z - z_hat``.

        The gain (n, q), or one for each phase (N, n, q), is that of ``x_hat(k+1) = A x_hat(k) +
        gain (y(k) - C x_hat(k))``; one of another size raises a DimensionError. What is not read
        has no gain.
        """
        gain = self.checked_gain(gain_predictor)
        D = np.zeros((len(self.L), self.B.shape[-1]))
        return StateSpace(
            A=self.A - gain @ self.C, B=self.B - gain @ self.D, C=self.L, D=D, dt_s=self.dt_s
        )

    def with_unit_weights(self) -> EstimationProblem:
        """Return the problem with each disturbance scaled to unit size.

        The columns of ``[B; D]`` are divided by their norms, so that the disturbances of
        the generalised plant act with identity weights.
        """
        self.require_one_phase("a scaling of disturbances", "one without")
        size = np.linalg.norm(np.vstack([self.B, self.D]), axis=0)
        size = np.where(size > 0, size, 1.0)
        return self.bare(B=self.B / size, D=self.D / size)

    def ahead(self, frames: int) -> EstimationProblem:
        """Problem whose one-step prediction is the estimate of ``z(k + frames)`` from y up to k.

        With 1 it is this problem. With 0 it is the filter (a-posteriori) form: the estimated
        signal gets a state of its own, one sample late. Less than 0 smooths with a fixed lag.
        With 2 or more the measurement gets states of its own, and the disturbances that
        arrive in between count in the error, where they are not delayed.

        The first states are x(k + max(frames, 1) - 1). A ProblemError is raised if ``frames`` is no
        integer; if it is 2 or more while ``B D'`` is not zero, as part of the noise would act on
        the states before it is measured; and if it is not 1 while the period is longer than a
        sample.
        """
        steps = integer(frames, "frames", at_least=-LONGEST_HORIZON, at_most=LONGEST_HORIZON)
        if steps == 1:
            return self
        self.require_one_phase(f"an estimate {steps} samples ahead", "frames=1")
        if steps > 1:
            size = np.linalg.norm(self.B, 2) * np.linalg.norm(self.D, 2)
            if np.linalg.norm(self.S, 2) > 1e-12 * size:
                raise ProblemError(
                    f"a prediction of {steps} samples needs process and measurement noise that are "
                    "uncorrelated (B D' = 0); got B D' with a norm of "
                    f"{np.linalg.norm(self.S, 2):.3g}. Try frames=1, or separate the noises."
                )
        entry = self.C if steps > 1 else self.L
        n, width = self.n_states, len(entry)
        late = width * (steps - 1 if steps > 1 else 1 - steps)
        A = np.eye(n + late, k=-width)
        A[:n] = 0.0
        A[: n + width, :n] = np.vstack([self.A, entry])
        last = np.eye(width, n + late, k=n + late - width)
        C, L = (np.hstack([part, np.zeros((len(part), late))]) for part in (self.C, self.L))
        B = np.vstack([self.B, np.zeros((late, self.B.shape[1]))])
        C, L = (last, L) if steps > 1 else (C, last)
        return self.bare(A=A, B=B, C=C, L=L)

    def with_memory(self, taps: FloatArray) -> EstimationProblem:
        """Add the past innovations of a filter as states, for filters that weight them.

        The true values of the new states are zero, so z is the same signal. A filter that feeds
        its innovations into them, with gain 1, estimates ``L x + taps [nu(k); nu(k-1); ...]``. The
        taps are (l, T q), the newest first, and add T q states; taps that do not fit raise a
        DimensionError.
        """
        self.require_one_phase("a filter with a memory", "one without")
        weights = matrix(taps, "taps", rows=(len(self.L), f"to match L {self.L.shape}"))
        q, size = self.C.shape[0], weights.shape[1]
        if size == 0 or size % q:
            raise DimensionError(
                f"taps must have a multiple of {q} columns, one for each measurement of each past "
                f"sample; got {weights.shape}."
            )
        A = block_diag(self.A, np.eye(size, k=-q))
        return replace(
            self,
            A=A,
            B=np.vstack([self.B, np.zeros((size, self.B.shape[1]))]),
            C=np.hstack([self.C, np.zeros((q, size))]),
            L=np.hstack([self.L, weights]),
        )

    def controller(self, gain_predictor: FloatArray) -> Controller:
        """Filter from y(k) to ``L x_hat(k+1 | k)``, the prediction of the next z.

        The predictor gain is (n, q) or (N, n, q); one of another size raises a DimensionError.
        """
        gain = self.checked_gain(gain_predictor)
        A, D = self.A - gain @ self.C, np.zeros_like(self.L @ gain)
        return Controller(A=A, B=gain, C=self.L, D=D, dt_s=self.dt_s)

    def checked_gain(self, gain: FloatArray, name: str = "gain_predictor") -> FloatArray:
        """Return gains (n, q), or (N, n, q) of a longer period, zero for what is not read."""
        gain = matrix(
            gain,
            name,
            rows=(self.n_states, f"to match A {self.A.shape}"),
            cols=(self.n_measurements, f"to match C {self.C.shape}"),
            stacked=True,
        )
        if gain.ndim > 2 and gain.shape[:-2] != (self.period,):
            raise DimensionError(
                f"{name} must be one matrix, or one for each of {self.period} phases; got "
                f"{gain.shape}."
            )
        if not self.read.all() or (self.period > 1 and gain.ndim == 2):
            gain = frozen_copy(gain * self.read[:, None, :])
        return gain[0] if self.period == 1 and gain.ndim > 2 else gain


def decorrelate(
    problem: EstimationProblem, t: int = 0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``A_s = A - S R^-1 C``, ``B_s`` with ``B_s D' = 0``, and ``S R^-1``, of a phase.

    Feeding the measurement into the state equation removes the correlation of process and
    measurement noise. A filter gain for (A_s, B_s) plus ``S R^-1`` is a gain for (A, B).
    """
    A, B, C, D = problem.read_parts(t)
    injection = np.linalg.solve(D @ D.T, (B @ D.T).T).T
    return frozen_copy(A - injection @ C), frozen_copy(B - injection @ D), frozen_copy(injection)


def error_units(covariance: FloatArray) -> FloatArray:
    """Units (n, 1) in which errors of this covariance have size one: powers of two, to be exact.

    Of a covariance per phase, (N, n, n), the largest counts.
    """
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    spread = np.sqrt(variances.reshape(-1, variances.shape[-1]).max(axis=0))
    usable = (spread > 1e-150) & (spread < 1e150)
    return nearest_powers_of_two(np.where(usable, spread, 1.0))[:, None]


def scale_states(problem: EstimationProblem, units: FloatArray) -> EstimationProblem:
    """Return the problem with its states divided by units (n, 1)."""
    A, B = problem.A * units.T / units, problem.B / units
    return problem.bare(A=A, B=B, C=problem.C * units.T, L=problem.L * units.T)
