"""The control law of a record: how its commands follow from its measurements, by least squares.

A law of order p computes, for each axis i and lags l from the first to the last one::

    u_i(k) = sum_j a_ij u_i(k-j) + sum_l B_il y(k-l),   j = 1..p

It is fitted to the increments u(k) - u(k-1): commands are large and smooth, and what tells the
laws apart is in their increments.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.faults import MAD, SURPRISING, find_saturated
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.linear import Controller
from lbt_synth.storage.words import count_text
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray, read_only, square

_LAGS = range(-4, 5)  # frames by which the first measurement may be late
_ROWS_PER_VALUE = 16  # of each coefficient: a law from fewer frames explains its own noise
_MOST_ROWS = 16_000  # frames of a regression: more move no law, and take seconds
SHORT_ORDER, _LONG_ORDER = 3, 32  # past commands: integrators, and filters of turbulence and lines
_EXACT = 1e-6  # part of the increments' variance that single precision leaves of an exact law
_SMALL = 0.05  # part of the variance, or of the largest element, which rounding may make
_SPARE = 0.2  # of the logarithm of what the richest law leaves, which a simple one may lack
# least coherence of an axis that follows its measurements, where other nights have 0.02; and part
# of the frames that follow no law, of which more are a law of their own
FOLLOWED = 0.1
_ADDS_UP = 0.2  # distance from 1 of the pole of an integrator, a leaky one included

_Shape: TypeAlias = tuple[int, range]  # order of a law, and the lags of its measurements


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlLaw:
    """What computed the commands of a record.

    In frames of the record, for each axis i::

        u_i(k) = sum_j past[i, j-1] u_i(k-j) + sum_l taps[i, l, :] y(k - lag_frames - l)

    The gain is the increment of u per unit of y at low frequencies: that of an integrator. It is u
    per unit of y of a law without memory, and the second increment of a double integrator; the size
    of one of higher order depends on all of its poles.
    """

    lag_frames: int  # of the first measurement; negative if commands know measurements to come
    past: FloatArray  # (axes, order), weights of past commands
    taps: FloatArray  # (axes, lags, axes), weights of measurements; zeros where there is no law
    residual: float  # unexplained part of the variance of the increments of u
    # (axes,); part that past commands leave and measurements explain: 1 of a deterministic law
    axis_coherence: FloatArray

    @property
    def order(self) -> int:
        """Past commands of an axis that the law uses."""
        return int(self.past.shape[1])

    @property
    def kind(self) -> str:
        """The law in a word; "none" where commands do not follow from the measurements."""
        if not np.any(self.taps):
            return "none"
        if self.order == 2 and np.all(abs(self.poles - 1) < _ADDS_UP):
            return "double integrator"
        return {0: "proportional", 1: "integrator"}.get(self.order, "higher order")

    @property
    def poles(self) -> ComplexArray:
        """The poles of each axis, (axes, order), the one nearest 1 first."""
        out = np.zeros(self.past.shape, dtype=np.complex128)
        for row, past in zip(out, self.past, strict=True):
            roots = np.roots(np.append(1.0, -past))  # without those at 0 of weights that vanish
            row[: roots.size] = roots
            row[:] = row[np.argsort(abs(row - 1), kind="stable")]
        return out

    @property
    def gain(self) -> FloatArray:
        """The gain, (axes, axes), small elements as zero."""
        # at low frequencies, but for the poles at 1
        others = self.poles[:, 2 if self.kind == "double integrator" else 1 :]
        gain = np.sum(self.taps, axis=1) / np.prod(abs(1 - others), axis=1)[:, None]
        return np.where(abs(gain) < _EXACT * np.max(abs(gain)), 0.0, gain)

    @property
    def axes_kind(self) -> str:
        """The structure of the gain, as classify_matrix says."""
        return classify_matrix(self.gain)[0]

    @property
    def exact(self) -> bool:
        """Whether the law leaves nothing but rounding."""
        return self.kind != "none" and self.residual < _EXACT

    @property
    def is_sure(self) -> bool:
        """Whether it explains so much that its lag counts."""
        return self.kind != "none" and self.residual < _SMALL

    @property
    def adds_up(self) -> bool:
        """Whether it adds up measurements, as positions do and increments do not."""
        return bool(self.order > 0 and np.all(abs(self.poles[:, 0] - 1) < _ADDS_UP))

    @property
    def gain_text(self) -> str:
        """The gains that are not zero by structure; one where all are the same."""
        gains = np.diag(self.gain) if self.axes_kind == "diagonal" else self.gain.ravel()
        texts = [f"{value:.4g}" for value in gains]
        return texts[0] if len(set(texts)) == 1 else ", ".join(texts)

    @property
    def name(self) -> str:
        """The law in words, but for its lag."""
        if self.kind == "none":
            return "no law"
        if self.order > 1:
            return f"a law of order {self.order}"
        return f"{'an integrator' if self.order else 'a proportional law'} of gain {self.gain_text}"

    @property
    def lag_text(self) -> str:
        """How late the commands follow, to go on in a sentence; empty where they are in time."""
        when = "late" if self.lag_frames > 0 else "early"
        frames = count_text(abs(self.lag_frames), "frame")
        return f", {frames} {when}" if self.lag_frames else ""

    @property
    def axis_lags(self) -> IntArray:
        """Lag of the first measurement that counts for each axis [frames], (axes,)."""
        size = np.linalg.norm(self.taps, axis=2)
        counts = size > _SMALL * np.max(size, axis=1, keepdims=True)
        return np.asarray(self.lag_frames + np.argmax(counts, axis=1))


def fit_control_law(record: LoopRecord) -> ControlLaw | None:
    """Return the law of least order that explains commands; None of an open loop or few frames."""
    if record.commands is None:
        return None
    y, u, good = record.measurements, record.commands, record.measured & record.commanded
    for column in u.T:
        good &= ~find_saturated(column, good)
    series = _Series(y, u, good, np.ones(len(y), dtype=np.bool_))
    with suppress(ProblemError):
        law = _search(series)
        for _ in range(2):  # jumps hide the other frames that do not follow the law
            odd = _odd_frames(series, law)
            if odd.any():
                series = series._replace(lawful=series.lawful & ~odd)
                law = _search(series)
        return law
    return None


class _Series(NamedTuple):
    """What laws are fitted to."""

    y: FloatArray  # (frames, axes)
    u: FloatArray  # (frames, axes)
    good: BoolArray  # (frames,)
    lawful: BoolArray  # (frames,), whose command is a result of the law

    def rows(self, order: int, lags: range) -> IntArray:
        """Return the frames k at which all values of a law are good."""
        frames = len(self.u)
        start, stop = max(order, 1, lags[-1]), min(frames, frames + lags[0])
        if stop <= start:
            return np.zeros(0, dtype=np.int64)
        complete = self.lawful[start:stop].copy()
        for lag in range(min(lags[0], 0), start + 1):
            complete &= self.good[start - lag : stop - lag]
        return start + np.flatnonzero(complete)


def _odd_frames(series: _Series, law: ControlLaw) -> BoolArray:
    """Return the frames that are far from a law, or jump where there is none, if they are few."""
    u, lags = series.u, range(law.lag_frames, law.lag_frames + law.taps.shape[1])
    rows = series.rows(law.order, lags)
    past = np.ones((u.shape[1], 1)) if law.kind == "none" else law.past
    rest = u[rows] - sum(past[:, j] * u[rows - 1 - j] for j in range(past.shape[1]))
    rest = rest - sum(series.y[rows - lag] @ law.taps[:, i].T for i, lag in enumerate(lags))
    rest = np.abs(rest - np.median(rest, axis=0))
    floor = np.sqrt(_EXACT) * np.median(np.abs(u[rows] - u[rows - 1]), axis=0)
    limit = np.maximum(2 * SURPRISING * MAD * np.median(rest, axis=0), floor)
    beyond = np.any(rest > limit, axis=1)
    odd = np.zeros(len(u), dtype=np.bool_)
    if np.mean(beyond) < FOLLOWED:
        odd[rows[beyond]] = True
    return odd


def _search(series: _Series) -> ControlLaw:
    """Return the shortest law that explains as much as a long one."""
    for order in (SHORT_ORDER, _LONG_ORDER):
        regression = _Regression(series, order)
        law = regression.describe(regression.simplest_shape(_LAGS))
        if law.exact or not regression.moving:
            return law
    # among laws nearly as good the one that knows least of the future: the sensor's answer to
    # commands may explain more, later and with the other sign
    for first in range(0, law.lag_frames, -1):
        later = regression.describe(regression.simplest_shape(range(first, _LAGS.stop)))
        if later.kind != "none" and (later.residual < _enough(law.residual) or not law.is_sure):
            return later
    return law


def _enough(residual: float) -> float:
    """Return what a simple law may leave where a rich one leaves a residual."""
    return float(residual ** (1 - _SPARE))


class _Regression:
    """Triangular factor of the increments and of all that may explain them."""

    def __init__(self, series: _Series, order: int) -> None:
        """Factorise laws of an order, or of the most that the frames allow, evenly spread."""
        y, u = series.y, series.u
        self.axes = u.shape[1]
        while True:
            lags = range(_LAGS[0], _LAGS[-1] + order + 1)
            rows = series.rows(order, lags)
            needed = _ROWS_PER_VALUE * (order + self.axes * len(lags))
            if rows.size >= needed:
                break
            if order <= 1:
                raise ProblemError(f"a law needs {needed} good frames; got {rows.size}.")
            order //= 2
        if rows.size > _MOST_ROWS:
            rows = rows[np.linspace(0, rows.size - 1, _MOST_ROWS).astype(np.int64)]
        self.order, self.lags, self.rows = order, lags, rows.size
        increments = np.diff(u, axis=0, prepend=u[:1])
        parts = [increments[rows], u[rows - 1]]
        parts += [increments[rows - lag] for lag in range(1, order)]
        parts += [y[rows - lag] for lag in lags]
        table = np.concatenate(parts, axis=1)
        table -= table.mean(axis=0)
        self.scale = np.maximum(np.sqrt(np.mean(table**2, axis=0)), 1e-300)
        self.factor: FloatArray = np.asarray(np.linalg.qr(table / self.scale, mode="r"))
        self.moving = [i for i in range(self.axes) if self.scale[i] ** 2 > 1e-30]

    def solve(self, axis: int, shape: _Shape) -> tuple[FloatArray, float]:
        """Return the weights of a law, and what it leaves of the increments' variance.

        A law without memory gives the command in place of its increment.
        """
        order, lags = shape
        target, past = self.factor[:, axis], axis + self.axes * np.arange(1, 1 + order)
        if not order:
            at = axis + self.axes
            target = target + self.factor[:, at] * self.scale[at] / self.scale[axis]
        first = self.axes * (1 + self.order + lags.start - self.lags.start)
        chosen = np.append(past, first + np.arange(self.axes * len(lags)))
        table = self.factor[:, chosen]
        weights = np.linalg.lstsq(table, target, rcond=None)[0]
        unexplained = target - table @ weights
        residual = float(unexplained @ unexplained) / self.rows
        return weights * self.scale[axis] / self.scale[chosen], residual

    def residual(self, shape: _Shape) -> float:
        """Return the part of the increments' variance that a law leaves, of the moving axes."""
        return float(np.mean([self.solve(axis, shape)[1] for axis in self.moving] or [1.0]))

    def coherence(self, shape: _Shape) -> FloatArray:
        """Return the part of what past commands leave that a law explains (axes,), unbiased."""
        out, used = np.zeros(self.axes), shape[0] + self.axes * len(shape[1])
        for axis in self.moving:
            before, after = (self.solve(axis, s)[1] for s in ((self.order, range(0)), shape))
            if before > 0:
                ratio = after / before * (self.rows - self.order) / (self.rows - used)
                out[axis] = max(0.0, 1 - ratio)
        return out

    def simplest_shape(self, lags: range) -> _Shape:
        """Return the shortest law that explains as much as the richest one, without idle taps."""
        most = _enough(self.residual((self.order, range(lags[0], self.lags.stop)))) + _EXACT**2
        tried = [(p, taps) for p in range(SHORT_ORDER + 1) for taps in range(max(p - 1, 0), p + 1)]
        while tried[-1][0] < self.order:
            tried.append((min(2 * tried[-1][0], self.order),) * 2)
        for order, taps in tried:
            shapes = [(order, range(lag, lag + taps + 1)) for lag in lags]
            residuals = [self.residual(shape) for shape in shapes]
            residual, shape = min(zip(residuals, shapes, strict=True), key=itemgetter(0))
            if residual <= most:
                break
        for early, late in ((1, 0), (0, -1)):
            while len(shape[1]) > 1:
                shorter = shape[0], range(shape[1].start + early, shape[1].stop + late)
                if self.residual(shorter) > (1 + _SMALL) * residual + _EXACT**2:
                    break
                shape = shorter
        return shape

    def describe(self, shape: _Shape) -> ControlLaw:
        """Return the law of a shape, without weights where the commands do not follow from it."""
        coherence, residual = self.coherence(shape), self.residual(shape)
        is_law = np.max(coherence) >= FOLLOWED
        axes, (order, lags) = self.axes, shape if is_law else (0, range(1))
        past, taps = np.zeros((axes, order)), np.zeros((axes, len(lags), axes))
        for axis in self.moving if is_law else ():
            weights, _ = self.solve(axis, shape)
            taps[axis] = weights[order:].reshape(len(lags), axes)
            if order:
                steps = np.append(weights[1:order], 0.0)  # of the increments before
                past[axis] = np.diff(steps, prepend=0.0)
                past[axis, 0] += 1 + weights[0]
        return ControlLaw(
            lag_frames=lags.start,
            past=read_only(past),
            taps=read_only(taps),
            residual=residual,
            axis_coherence=read_only(coherence),
        )


def classify_matrix(values: ArrayLike) -> tuple[str, tuple[int, ...]]:
    """Return what a matrix (n, n) of one or two axes does, and the sign of each row, or 0."""
    g = square(values, "values")
    g = np.where(np.abs(g) <= _SMALL * np.max(np.abs(g), initial=0.0), 0.0, g)
    on, off = np.diag(g), (g - np.diag(np.diag(g))).sum(axis=1)
    if not g.any():
        return "zero", (0,) * len(g)
    if on.any() and off.any():
        return "general", (0,) * len(g)
    return "diagonal" if on.any() else "swapped", tuple(int(sign) for sign in np.sign(on + off))


def law_controller(law: ControlLaw, frame_rate_hz: float) -> Controller:
    """Return a law as a controller, whose state holds past commands and measurements."""
    if law.kind == "none" or law.lag_frames < 0:
        raise ProblemError(f"a controller needs a law that can run; got {law.name}{law.lag_text}.")
    axes, last = len(law.gain), law.lag_frames + law.taps.shape[1] - 1
    slots = max(law.order, 1)  # of u(k-1), u(k-2), ...; then last of y(k-1), y(k-2), ...
    shift = np.eye(slots + last, k=-1)  # each slot moves to the next one of its kind
    shift[slots : slots + 1] = 0.0
    A = np.asarray(np.kron(shift, np.eye(axes)), dtype=np.float64)
    taps = np.concatenate([np.zeros((axes, law.lag_frames, axes)), law.taps], axis=1)
    for j in range(law.order):
        A[:axes, axes * j : axes * (j + 1)] = np.diag(law.past[:, j])
    A[:axes, axes * slots :] = taps[:, 1:].reshape(axes, -1)
    B = np.zeros((len(A), axes))
    B[:axes] = taps[:, 0]
    if last:
        B[axes * slots : axes * (slots + 1)] = np.eye(axes)
    return Controller(
        A=A, B=B, C=np.eye(axes, len(A)), D=np.zeros((axes, axes)), dt_s=1 / frame_rate_hz
    )
