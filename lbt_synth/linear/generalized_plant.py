"""The generalised plant: what a controller sees and moves, and what it is judged by."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy.linalg import matrix_balance

from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.storage.summaries import Summarised
from lbt_synth.storage.words import count_text
from lbt_synth.validation import (
    FloatArray,
    integer,
    matrix,
    number,
    require_instance,
    set_fields,
    square,
)

_ILL_POSED = 1e-12
_ZERO = cast(FloatArray, None)  # of a feedthrough that is not given


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GeneralizedPlant(Summarised):
    """Plant from disturbances w and controls u to errors z and measurements y.

    ``x(k+1) = A x + B1 w + B2 u``, ``z = C1 x + D11 w + D12 u``, ``y = C2 x + D21 w + D22 u``.

    Parameters
    ----------
    A : (n, n) array_like
        State matrix.
    B1, B2 : (n, m1), (n, m2) array_like
        Disturbance and control to state.
    C1, C2 : (p1, n), (p2, n) array_like
        State to error and to measurement.
    D11, D12, D21, D22 : array_like, optional
        Feedthroughs (p1, m1), (p1, m2), (p2, m1), (p2, m2); zero where not given.
    dt_s : float, optional
        Sampling period [s]; 1 when the samples have no physical rate.

    Raises
    ------
    ProblemError
        If a matrix is not finite, the sizes clash, or there is no sampling period.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> P = lbt.linear.GeneralizedPlant(
    ...     A=1.0,
    ...     B1=[[1.0, 0.0]],
    ...     B2=1.0,
    ...     C1=[[1.0], [0.0]],
    ...     C2=1.0,
    ...     D12=[[0.0], [1.0]],
    ...     D21=[[0.0, 1.0]],
    ... )
    >>> P
    <GeneralizedPlant: 1 state, 2 disturbances, 1 control, 2 errors, 1 measurement>
    """

    A: FloatArray
    B1: FloatArray
    B2: FloatArray
    C1: FloatArray
    C2: FloatArray
    D11: FloatArray = _ZERO
    D12: FloatArray = _ZERO
    D21: FloatArray = _ZERO
    D22: FloatArray = _ZERO
    dt_s: float = 1.0

    def __post_init__(self) -> None:
        A = square(self.A, "A")
        why = f"to match A {A.shape}"
        B1, B2 = (matrix(getattr(self, k), k, rows=(len(A), why)) for k in ("B1", "B2"))
        C1, C2 = (matrix(getattr(self, k), k, cols=(len(A), why)) for k in ("C1", "C2"))
        set_fields(self, A=A, B1=B1, B2=B2, C1=C1, C2=C2)
        for i, C in enumerate((C1, C2), 1):
            for j, B in enumerate((B1, B2), 1):
                name = f"D{i}{j}"
                given = getattr(self, name)
                value = np.zeros((len(C), B.shape[1])) if given is _ZERO else given
                rows = (len(C), f"to match C{i} {C.shape}")
                cols = (B.shape[1], f"to match B{j} {B.shape}")
                set_fields(self, **{name: matrix(value, name, rows=rows, cols=cols)})
        for word, value in (("B1", B1.T), ("B2", B2.T), ("C1", C1), ("C2", C2)):
            if not len(value):
                raise DimensionError(f"{word} must have at least one signal; got {value.shape}.")
        set_fields(self, dt_s=number(self.dt_s, "dt_s", above=0))

    def _brief(self) -> str:
        words = ("state", "disturbance", "control", "error", "measurement")
        sizes = (len(self.A), *self.sizes)
        return ", ".join(count_text(*each) for each in zip(sizes, words, strict=True))

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Numbers of disturbances, controls, errors and measurements."""
        return self.B1.shape[1], self.B2.shape[1], len(self.C1), len(self.C2)

    @classmethod
    def of(cls, system: Any, *, measurements: int, controls: int) -> GeneralizedPlant:
        """Partition a system whose last inputs are the controls, whose last outputs are measured.

        It is a StateSpace, or what :meth:`StateSpace.of` takes. If no disturbance or no error is
        left, or the system is in continuous time, a ProblemError is raised.
        """
        G = StateSpace.of(system)
        p, m = G.D.shape
        q = integer(measurements, "measurements", at_least=1, at_most=p - 1)
        r = integer(controls, "controls", at_least=1, at_most=m - 1)
        A, (B1, B2) = G.A, np.split(G.B, [m - r], axis=1)
        C1, C2 = np.split(G.C, [p - q])
        (D11, D12), (D21, D22) = (
            np.split(rows, [m - r], axis=1) for rows in np.split(G.D, [p - q])
        )
        parts = {"A": A, "B1": B1, "B2": B2, "C1": C1, "C2": C2}
        return cls(**parts, D11=D11, D12=D12, D21=D21, D22=D22, dt_s=G.dt_s)

    @property
    def whole(self) -> StateSpace:
        """System from [w; u] to [z; y]."""
        B, C = np.hstack([self.B1, self.B2]), np.vstack([self.C1, self.C2])
        D = np.block([[self.D11, self.D12], [self.D21, self.D22]])
        return StateSpace(A=self.A, B=B, C=C, D=D, dt_s=self.dt_s)

    def transposed(self) -> GeneralizedPlant:
        """Return the plant whose control is the estimation of this one, in costates."""
        turned = {"A": "A", "B1": "C1", "B2": "C2", "C1": "B1", "C2": "B2"}
        turned |= {"D11": "D11", "D12": "D21", "D21": "D12", "D22": "D22"}
        parts = {name: getattr(self, other).T for name, other in turned.items()}
        return GeneralizedPlant(**parts, dt_s=self.dt_s)

    def closed_loop(self, controller: StateSpace) -> StateSpace:
        """Return the system from w to z with ``u = K y``, for K from y (p2) to u (m2).

        A controller that does not fit is a DimensionError or, as another sampling period, a
        ProblemError; a singular ``I - D22 D``, with which the loop has no solution, is a
        NumericalError.
        """
        require_instance(controller, StateSpace, "controller")
        _, m2, _, p2 = self.sizes
        K = controller
        if K.D.shape != (m2, p2):
            raise DimensionError(
                f"the controller must map {p2} measurements to {m2} controls; got D {K.D.shape}."
            )
        if K.dt_s != self.dt_s:
            raise ProblemError(
                f"plant and controller must have one sampling period; got {self.dt_s:.6g} s and "
                f"{K.dt_s:.6g} s."
            )
        x, w, y = len(self.A), self.B1.shape[1], invert_well_posed(self.D22, K.D)
        # y = loop (C2 x + D21 w + D22 C xk)
        measured = y @ np.hstack([self.C2, self.D22 @ K.C, self.D21])
        control = K.D @ measured
        control[:, x : x + len(K.A)] += K.C
        rows = np.vstack(
            [
                np.hstack([self.A, np.zeros((x, len(K.A))), self.B1]) + self.B2 @ control,
                np.hstack([np.zeros((len(K.A), x)), K.A, np.zeros((len(K.A), w))]) + K.B @ measured,
            ]
        )
        error = np.hstack([self.C1, np.zeros((len(self.C1), len(K.A))), self.D11])
        error = error + self.D12 @ control
        n = x + len(K.A)
        return replace(K, A=rows[:, :n], B=rows[:, n:], C=error[:, :n], D=error[:, n:])


def invert_well_posed(D22: FloatArray, D: FloatArray) -> FloatArray:
    """Return ``(I - D22 D)^-1``, (p2, p2); refuse a singular one, in any units of y."""
    loop, (units, _) = matrix_balance(np.eye(len(D22)) - D22 @ D, permute=False, separate=True)
    size = max(1.0, float(np.linalg.norm(loop)))
    if np.linalg.svd(loop, compute_uv=False)[-1] < _ILL_POSED * size:
        raise NumericalError(
            "the loop is not well posed: I - D22 D is singular, so control and measurement of "
            "one instant contradict each other. Try a slightly larger gamma, or a delay in the "
            "plant.",
            status="ill posed",
        )
    return np.asarray(units[:, None] * np.linalg.inv(loop) / units)
