"""The estimation problem that every filter in this package solves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import DefinitenessError, DimensionError, ProblemError
from lbt_synth.linear.matrix_functions import nearest_powers_of_two
from lbt_synth.linear.state_space import Controller, LinearSystem, StateSpace
from lbt_synth.validation import (
    FloatArray,
    definite,
    frozen_copy,
    integer,
    matrix,
    set_fields,
    suggest_part,
)

LONGEST_HORIZON = 100  # samples


def require_problem(problem: object) -> None:
    """Refuse anything but an estimation problem."""
    if not isinstance(problem, EstimationProblem):
        hint = suggest_part(problem, EstimationProblem)
        hint = hint or " Try EstimationProblem(A=..., B=..., C=..., D=..., L=...)."
        raise ProblemError(
            f"expected an EstimationProblem, such as a plant; got {type(problem).__name__}.{hint}"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EstimationProblem(LinearSystem):
    """Estimate ``z = L x`` from past ``y``, where ``x+ = A x + B w`` and ``y = C x + D w``.

    The filter is the strictly causal one-step predictor: the estimate of z(k)
    uses y up to k-1. For the Kalman filter w is white noise of unit variance,
    for the H-infinity filter any signal of unit energy; B and D hold the
    weights. B D' need not be zero.

    Parameters
    ----------
    A : (n, n) array_like
        State matrix.
    B : (n, p) array_like
        Disturbance to state.
    C : (q, n) array_like
        State to measurement.
    D : (q, p) array_like
        Disturbance to measurement; ``D D'`` must be positive definite.
    L : (l, n) array_like
        State to the signal that is estimated.
    dt_s : float, optional
        Sampling period [s]; 1 when the samples have no physical rate.

    Raises
    ------
    DimensionError
        If sizes clash.
    NonFiniteError
        If an entry is NaN or infinite.
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

    def __post_init__(self) -> None:
        LinearSystem.__post_init__(self)
        L = matrix(self.L, "L", cols=(self.n_states, f"to match A {self.A.shape}"))
        set_fields(self, L=L)
        try:
            definite(self.D @ self.D.T, "D D'")
        except DefinitenessError as error:
            raise DefinitenessError(
                f"{error} Every measurement needs noise of its own: add a column to D."
            ) from error

    def _shown_system(self) -> tuple[StateSpace, str]:
        """Return the system from w to the estimated signal."""
        D = np.zeros((len(self.L), self.B.shape[1]))
        system = StateSpace(A=self.A, B=self.B, C=self.L, D=D, dt_s=self.dt_s)
        return system, "largest singular value from w to z"

    @property
    def Q(self) -> FloatArray:
        """Covariance of the process noise, ``B B'`` (n, n)."""
        return frozen_copy(self.B @ self.B.T)

    @property
    def R(self) -> FloatArray:
        """Covariance of the measurement noise, ``D D'`` (q, q)."""
        return frozen_copy(self.D @ self.D.T)

    @property
    def S(self) -> FloatArray:
        """Cross-covariance of process and measurement noise, ``B D'`` (n, q)."""
        return frozen_copy(self.B @ self.D.T)

    def error_system(self, gain_predictor: FloatArray) -> StateSpace:
        """System ``(A - gain C, B - gain D, L, 0)`` from w to a predictor's error ``z - z_hat``.

        The gain (n, q) is that of ``x_hat(k+1) = A x_hat(k) + gain (y(k) - C x_hat(k))``; one of
        another size raises a DimensionError.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> p = lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
        >>> float(p.error_system([[0.4]]).A[0, 0])
        0.5
        """
        gain = self._checked_gain(gain_predictor)
        D = np.zeros((len(self.L), self.B.shape[1]))
        return StateSpace(
            A=self.A - gain @ self.C, B=self.B - gain @ self.D, C=self.L, D=D, dt_s=self.dt_s
        )

    def with_unit_weights(self) -> EstimationProblem:
        """Return the problem with each disturbance scaled to unit size.

        The columns of ``[B; D]`` are divided by their norms, so that the disturbances of
        the generalised plant act with identity weights.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> p = lbt.EstimationProblem(A=0.9, B=[[5.0, 0.0]], C=1.0, D=[[0.0, 2.0]], L=1.0)
        >>> p.with_unit_weights().B.tolist()
        [[1.0, 0.0]]
        """
        size = np.linalg.norm(np.vstack([self.B, self.D]), axis=0)
        size = np.where(size > 0, size, 1.0)
        A, C, L = self.A, self.C, self.L
        return EstimationProblem(A=A, B=self.B / size, C=C, D=self.D / size, L=L, dt_s=self.dt_s)

    def ahead(self, frames: int) -> EstimationProblem:
        """Problem whose one-step prediction is the estimate of ``z(k + frames)`` from y up to k.

        With 1 it is this problem. With 0 it is the filter (a-posteriori) form: the estimated
        signal gets a state of its own, one sample late. Less than 0 smooths with a fixed lag.
        With 2 or more the measurement gets states of its own, and the disturbances that
        arrive in between count in the error, where they are not delayed.

        Parameters
        ----------
        frames : int
            Samples from the newest measurement to the estimate.

        Returns
        -------
        EstimationProblem
            The problem, with more states; the first ones are x(k + max(frames, 1) - 1).

        Raises
        ------
        ProblemError
            If ``frames`` is no integer, or is 2 or more while ``B D'`` is not zero: part of
            the noise would act on the states before it is measured.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
        >>> [round(lbt.kalman(walk, horizon=h).rms ** 2, 6) for h in (-1, 0, 1, 2)]
        [0.472136, 0.618034, 1.618034, 2.618034]
        """
        steps = integer(frames, "horizon", at_least=-LONGEST_HORIZON, at_most=LONGEST_HORIZON)
        if steps == 1:
            return self
        if steps > 1:
            size = np.linalg.norm(self.B, 2) * np.linalg.norm(self.D, 2)
            if np.linalg.norm(self.S, 2) > 1e-12 * size:
                raise ProblemError(
                    f"a prediction of {steps} samples needs process and measurement noise that are "
                    "uncorrelated (B D' = 0); got B D' with a norm of "
                    f"{np.linalg.norm(self.S, 2):.3g}. Try horizon=1, or separate the noises."
                )
        entry = self.C if steps > 1 else self.L
        n, width = self.n_states, len(entry)
        late = width * (steps - 1 if steps > 1 else 1 - steps)
        A = np.eye(n + late, k=-width)
        A[:n] = 0.0
        A[: n + width, :n] = np.vstack([self.A, entry])
        last = np.eye(width, n + late, k=n + late - width)
        C, L = (np.hstack([part, np.zeros((len(part), late))]) for part in (self.C, self.L))
        return EstimationProblem(
            A=A,
            B=np.vstack([self.B, np.zeros((late, self.B.shape[1]))]),
            C=last if steps > 1 else C,
            D=self.D,
            L=L if steps > 1 else last,
            dt_s=self.dt_s,
        )

    def with_memory(self, taps: FloatArray) -> EstimationProblem:
        """Add the past innovations of a filter as states, for filters that weight them.

        The true values of the new states are zero, so z is the same signal. A filter that feeds
        its innovations into them, with gain 1, estimates ``L x + taps [nu(k); nu(k-1); ...]``. The
        taps are (l, T q), the newest first, and add T q states; taps that do not fit raise a
        DimensionError.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
        >>> walk.with_memory([[0.3, 0.1]]).n_states
        3
        """
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

    def estimator(self, gain_predictor: FloatArray) -> Controller:
        """Estimator of z from all known signals: here from y(k), as :meth:`controller`."""
        return self.controller(gain_predictor)

    def controller(self, gain_predictor: FloatArray) -> Controller:
        """Filter from y(k) to ``L x_hat(k+1 | k)``, the prediction of the next z.

        The predictor gain is (n, q); one of another size raises a DimensionError.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> p = lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
        >>> float(p.controller([[0.4]]).start().step([1.0])[0])
        0.4
        """
        gain = self._checked_gain(gain_predictor)
        A, D = self.A - gain @ self.C, np.zeros_like(self.L @ gain)
        return Controller(A=A, B=gain, C=self.L, D=D, dt_s=self.dt_s)

    def _checked_gain(self, gain_predictor: FloatArray) -> FloatArray:
        return matrix(
            gain_predictor,
            "gain_predictor",
            rows=(self.A.shape[0], f"to match A {self.A.shape}"),
            cols=(self.C.shape[0], f"to match C {self.C.shape}"),
        )


def decorrelate(problem: EstimationProblem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``A_s = A - S R^-1 C``, ``B_s`` with ``B_s D' = 0``, and ``S R^-1``.

    Feeding the measurement into the state equation removes the correlation of process and
    measurement noise. A filter gain for (A_s, B_s) plus ``S R^-1`` is a gain for (A, B).
    """
    injection = np.linalg.solve(problem.R, problem.S.T).T
    return (
        frozen_copy(problem.A - injection @ problem.C),
        frozen_copy(problem.B - injection @ problem.D),
        frozen_copy(injection),
    )


def filter_gains(
    problem: EstimationProblem, information: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Predictor and filter gain of the information matrix ``M = Pt^-1``, which may be singular.

    ``gain_filter = (M + C'R^-1 C)^-1 C'R^-1`` stays finite.
    """
    A_s, _, injection = decorrelate(problem)
    weighted = np.linalg.solve(problem.R, problem.C).T  # C' R^-1
    gain_filter = np.linalg.solve(information + weighted @ problem.C, weighted)
    return frozen_copy(A_s @ gain_filter + injection), frozen_copy(gain_filter)


def error_units(covariance: FloatArray) -> FloatArray:
    """Units (n, 1) in which errors of this covariance have size one: powers of two, to be exact."""
    spread = np.sqrt(np.diag(covariance))
    usable = (spread > 1e-150) & (spread < 1e150)
    return nearest_powers_of_two(np.where(usable, spread, 1.0))[:, None]


def scale_states(problem: EstimationProblem, units: FloatArray) -> EstimationProblem:
    """Return the problem with its states divided by units (n, 1)."""
    return EstimationProblem(
        A=problem.A * units.T / units,
        B=problem.B / units,
        C=problem.C * units.T,
        D=problem.D,
        L=problem.L * units.T,
        dt_s=problem.dt_s,
    )
