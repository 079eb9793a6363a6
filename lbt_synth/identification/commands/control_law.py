"""The control law of a record: how its commands follow from its measurements.

What a matrix between two pairs of axes does: signs, exchanged axes, or a mixture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.commands.law_search import (
    LAGS,
    SHORT_ORDER,
    LawCoefficients,
    LawShape,
    LoopSeries,
    Regression,
    prepare_series,
    simplest_law,
    simplest_short_law,
)
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.validation import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    matrix,
    number,
    read_only,
    square,
)

LawKind: TypeAlias = Literal[
    "pure integrator",
    "leaky integrator",
    "double integrator",
    "proportional",
    "higher order",
    "none",
]
_LEAST_ROWS = 400
_EXACT = 1e-6  # part of the increments' variance, below which a law is exact
_LONG_ORDER = 32
_SHORT_ROWS, _LONG_ROWS = 60_000, 16_000
_ROWS_PER_VALUE = 8
_LEAST_COHERENCE = 0.1
_PASSES = 3
_NEAR_ONE = 0.1  # distance of both poles of a double integrator
_LEAKY = 0.5  # least pole of a leaky one
_PURE = 1e-6
_ROUNDING = 1e-12
_AS_GOOD = 0.9
_NEARLY = 2.0  # times the residual of a law that knows the future, which one that does not may have
_SURE = 0.05  # most that a law leaves unexplained whose lag counts
FOLLOWED = 0.5  # coherence of an axis whose law counts
AxisKind: TypeAlias = Literal["diagonal", "swapped", "general", "zero"]
_SIGMAS = 4.0  # standard errors within which a weight is zero
_TOLERANCE = 0.05  # of the largest element


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlLaw:
    """What computed the commands of a record.

    In frames of the record, for each axis i::

        u_i(k) = sum_j past[i, j-1] u_i(k-j) + sum_l taps[i, l, :] y(k - lag_frames - l)

    The gain is the increment of u per unit of y at low frequencies: that of an integrator. It is u
    per unit of y of a law without memory, and the second increment of a double integrator; the size
    of one of higher order depends on all of its poles.
    """

    kind: LawKind  # "none": the commands do not follow from the measurements
    # of the first measurement; negative if commands know measurements of the future
    lag_frames: int
    gain: FloatArray  # (axes, axes); zeros where there is no law
    gain_error: FloatArray  # (axes, axes), standard errors
    axis_matrix: AxisMatrix  # signs and structure of the gain
    leak: FloatArray  # (axes,), pole nearest 1; nan without memory
    poles: ComplexArray  # (axes, order)
    order: int  # past commands of an axis that the law uses
    past: FloatArray  # (axes, order), weights of past commands
    taps: FloatArray  # (axes, lags, axes), weights of measurements
    residual: float  # unexplained part of the variance of the increments of u
    # 1 of a deterministic law, 0 of the commands of another night; mean of the axes
    coherence: float
    axis_coherence: FloatArray  # (axes,); part that past commands leave and measurements explain
    odd_frames: int  # frames left out because they do not follow the law of the others

    @property
    def exact(self) -> bool:
        """Whether the law leaves nothing but rounding."""
        return self.kind != "none" and self.residual < _EXACT

    @property
    def is_sure(self) -> bool:
        """Whether it explains so much that its lag counts."""
        return self.kind != "none" and self.residual < _SURE

    @property
    def is_ordinary(self) -> bool:
        """Whether it is sure, without a lag, and each axis follows its own measurements."""
        own = self.axis_matrix.kind == "diagonal" and min(self.axis_matrix.signs) > 0
        return self.is_sure and self.lag_frames == 0 and own

    @property
    def axis_lags(self) -> IntArray:
        """Lag of the first measurement that counts for each axis [frames], (axes,)."""
        size = np.linalg.norm(self.taps, axis=2)
        counts = size > _TOLERANCE * np.max(size, axis=1, keepdims=True)
        return np.asarray(self.lag_frames + np.argmax(counts, axis=1))


def record_control_law(record: LoopRecord) -> ControlLaw:
    """Return the control law of a closed-loop record.

    Parameters
    ----------
    record : LoopRecord
        The record; its delay does not matter.

    Returns
    -------
    ControlLaw
        The law.

    Raises
    ------
    ProblemError
        If the record has no commands, or too few good frames.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> y = np.random.default_rng(1).standard_normal((2000, 1))
    >>> u = -0.4 * np.cumsum(y, axis=0)
    >>> record = lbt.identification.loop_record(y, u, frame_rate_hz=1000, unit="nm")
    >>> law = lbt.identification.record_control_law(record)
    >>> law.kind, law.lag_frames, law.gain.round(6).tolist()
    ('pure integrator', 0, [[-0.4]])
    """
    if record.commands is None:
        raise ProblemError(
            "the control law needs commands; the record is of an open loop. Give the commands."
        )
    measured = record.usable if record.measured is None else record.measured
    return _find_law(record.measurements, record.commands, measured, record.commanded)


def fit_control_law(
    measurements: ArrayLike, commands: ArrayLike, *, usable: ArrayLike | None = None
) -> ControlLaw:
    """Return the law with the least order that explains commands by measurements.

    Frames at which a command is at a limit do not count, nor those few that do not follow the
    law of the others.

    Parameters
    ----------
    measurements, commands : (frames, axes) array_like
        Measurements y(k) and commands u(k) of one or two axes, in the same unit.
    usable : (frames,) bool array_like, optional
        Frames whose values are good; all by default.

    Returns
    -------
    ControlLaw
        The law; of kind "none" if the commands do not follow from the measurements.

    Raises
    ------
    ProblemError
        If sizes clash, or too few frames are good.

    Examples
    --------
    >>> import numpy as np
    >>> y = np.random.default_rng(1).standard_normal((2000, 2))
    >>> u = 0.3 * np.cumsum(y[:, ::-1], axis=0)  # axes swapped
    >>> law = fit_control_law(y, u)
    >>> law.kind, law.axis_matrix.kind, law.gain.round(6).tolist()
    ('pure integrator', 'swapped', [[0.0, 0.3], [0.3, 0.0]])
    """
    y = matrix(measurements, "measurements")
    why = f"to match measurements {y.shape}"
    u = matrix(commands, "commands", rows=(len(y), why), cols=(y.shape[1], why))
    good = np.ones(len(y), dtype=np.bool_) if usable is None else np.array(usable)
    if good.dtype != np.bool_ or good.shape != (len(y),):
        raise DimensionError(
            f"usable must be {len(y)} truth values, one per frame; got {good.dtype} {good.shape}."
        )
    return _find_law(y, u, good, good)


def _find_law(
    y: FloatArray, u: FloatArray, measured: BoolArray, commanded: BoolArray | None
) -> ControlLaw:
    """Fit the law, and again without the frames that do not follow it."""
    series = prepare_series(y, u, measured, commanded)
    for _ in range(_PASSES):
        law = _search(series)
        lags = range(law.lag_frames, law.lag_frames + law.taps.shape[1])
        odd = series.odd_frames(law.past, law.taps, lags)
        if not odd.any() or law.kind == "none":
            break
        series = replace(series, followed=series.followed & ~odd)
    return replace(law, odd_frames=int(np.sum(~series.followed)))


def _search(series: LoopSeries) -> ControlLaw:
    """Return the shortest law that explains as much as a long one."""
    regression = _regression(series, SHORT_ORDER, _SHORT_ROWS)
    if not regression.moving:
        return _no_law(regression)
    found = simplest_short_law(regression)
    if found is None or regression.residual(found) > _EXACT:
        regression = _regression(series, _LONG_ORDER, _LONG_ROWS)
        if found is None or regression.residual(found) > regression.most_residual():
            found = simplest_law(regression)
    law = _describe(regression, found)
    return _least_anticipating(regression, law) if law.lag_frames < 0 and not law.exact else law


def _least_anticipating(regression: Regression, law: ControlLaw) -> ControlLaw:
    """Return the law that knows least of the future among those nearly as good as one that does.

    The sensor's answer to commands may explain more: it comes later, with the other sign.
    """
    for first in range(0, law.lag_frames, -1):
        later = _describe(regression, simplest_law(regression, range(first, LAGS.stop)))
        if later.kind != "none" and later.residual < _NEARLY * law.residual:
            return later
        if first == 0 and not law.is_sure:
            as_good = np.max(later.axis_coherence) > _AS_GOOD * np.max(law.axis_coherence)
            if as_good or np.sum(later.taps[:, 0] * law.taps[:, 0]) < 0:
                return later
    return law


def _regression(series: LoopSeries, order: int, most_rows: int) -> Regression:
    """Return the regression of laws of an order, or of the most that the frames allow."""
    while True:
        lags = range(LAGS[0], LAGS[-1] + order + 1)
        rows = series.rows(order, lags).size
        if rows >= max(_LEAST_ROWS, _ROWS_PER_VALUE * (order + series.axes * len(lags))):
            return Regression(series, order, lags, most_rows)
        if order <= 1:
            raise ProblemError(
                f"the control law needs {_LEAST_ROWS} frames whose neighbours are good; got "
                f"{rows} of {len(series.commands)}. Give a longer record, or one with fewer holes."
            )
        order //= 2


def _describe(regression: Regression, shape: LawShape) -> ControlLaw:
    """Return the law of a shape, in words."""
    found = regression.coefficients(shape)
    unexplained = regression.residual(shape)
    coherence = regression.coherence(shape)
    if np.max(coherence) < _LEAST_COHERENCE:
        return _no_law(regression, residual=unexplained, coherence=coherence)
    poles = _poles(found.past)
    kind = _kind(shape, found, poles)
    gain, error = _gain(found, poles[:, 2 if kind == "double integrator" else 1 :])
    return ControlLaw(
        kind=kind,
        lag_frames=shape.first,
        gain=read_only(gain),
        gain_error=read_only(error),
        axis_matrix=classify_matrix(gain, error),
        leak=read_only(_leak(poles)),
        poles=read_only(poles),
        order=shape.order,
        past=read_only(found.past),
        taps=read_only(found.taps),
        residual=unexplained,
        coherence=float(np.mean(coherence)),
        axis_coherence=read_only(coherence),
        odd_frames=0,
    )


def _poles(past: FloatArray) -> ComplexArray:
    """Return the poles of each axis, (axes, order), the one nearest 1 first."""
    each = [np.roots(np.append(1.0, -row)).astype(np.complex128) for row in past]
    padded = [np.append(row, np.zeros(past.shape[1] - row.size)) for row in each]
    return np.array([row[np.argsort(abs(row - 1), kind="stable")] for row in padded])


def _leak(poles: ComplexArray) -> FloatArray:
    """Return the pole nearest 1 of each axis, its size where it is complex, (axes,)."""
    if not poles.shape[1]:
        return np.full(len(poles), np.nan)
    nearest = poles[:, 0]
    return np.where(abs(nearest.imag) > 0, abs(nearest), nearest.real)


def _gain(found: LawCoefficients, others: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return the gain at low frequencies but for the poles at 1, and its errors."""
    axes, lags, _ = found.taps.shape
    scale = np.prod(abs(1 - others), axis=1)[:, None]
    variance = np.einsum("iljmj->ij", found.taps_covariance.reshape(axes, lags, axes, lags, axes))
    gain = np.sum(found.taps, axis=1) / scale
    gain[abs(gain) < _ROUNDING * np.max(abs(gain))] = 0.0
    return gain, np.sqrt(np.maximum(variance, 0)) / scale


def _kind(shape: LawShape, found: LawCoefficients, poles: ComplexArray) -> LawKind:
    """Return the word for a law."""
    if shape.order == 0:
        return "proportional"
    distance = abs(poles - 1)
    if shape.order == 1 and np.all(distance <= np.maximum(_PURE, 4 * found.past_error)[:, None]):
        return "pure integrator"
    if shape.order == 1 and np.all(poles.real > _LEAKY):
        return "leaky integrator"
    if shape.order == 2 and np.all(distance < _NEAR_ONE):
        return "double integrator"
    return "higher order"


def _no_law(
    regression: Regression, *, residual: float = 1.0, coherence: FloatArray | None = None
) -> ControlLaw:
    """Return the law of commands that do not follow from the measurements, or do not move."""
    axes = regression.axes
    known = np.zeros(axes) if coherence is None else coherence
    zeros = np.zeros((axes, axes))
    return ControlLaw(
        kind="none",
        lag_frames=0,
        gain=read_only(zeros),
        gain_error=read_only(zeros.copy()),
        axis_matrix=classify_matrix(zeros),
        leak=read_only(np.full(axes, np.nan)),
        poles=read_only(np.zeros((axes, 0), dtype=np.complex128)),
        order=0,
        past=read_only(np.zeros((axes, 0))),
        taps=read_only(np.zeros((axes, 1, axes))),
        residual=residual,
        coherence=float(np.mean(known)),
        axis_coherence=read_only(known),
        odd_frames=0,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxisMatrix:
    """Structure of a matrix between axes.

    Attributes
    ----------
    kind : str
        "diagonal"; "swapped" (only the other diagonal is not zero); "general" (a rotation, for
        example); "zero" (nothing differs from 0).
    signs : (axes,) tuple of int
        Signs of the elements on the diagonal, of a swapped matrix on the other one, of each row;
        0 of any other.
    """

    kind: AxisKind
    signs: tuple[int, ...]


def classify_matrix(
    values: ArrayLike, errors: ArrayLike = 0.0, *, tolerance: float = _TOLERANCE
) -> AxisMatrix:
    """Return what a matrix (n, n) of one or two axes does: the first kind that fits.

    Elements within four standard errors of zero, or below a part of the largest one, the tolerance,
    count as zero.
    """
    g = square(values, "values")
    part = number(tolerance, "tolerance", at_least=0)
    doubt = _SIGMAS * np.broadcast_to(np.asarray(errors, dtype=float), g.shape)
    least = np.where(np.isfinite(doubt), doubt, np.inf)
    g = np.where(np.abs(g) <= np.maximum(least, part * np.max(np.abs(g), initial=0.0)), 0.0, g)
    on, off = np.diag(g), (g - np.diag(np.diag(g))).sum(axis=1)
    if not g.any():
        return AxisMatrix(kind="zero", signs=(0,) * len(g))
    if not off.any():
        return AxisMatrix(kind="diagonal", signs=_signs(on))
    if not on.any():
        return AxisMatrix(kind="swapped", signs=_signs(off))
    return AxisMatrix(kind="general", signs=(0,) * len(g))


def _signs(values: FloatArray) -> tuple[int, ...]:
    return tuple(int(sign) for sign in np.sign(values))
