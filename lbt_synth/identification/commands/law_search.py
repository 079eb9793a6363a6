"""Least squares of commands on past commands and measurements, by order and lag.

A law of order p whose first measurement is ``first`` frames old computes, for each axis i::

    u_i(k) = sum_j a_ij u_i(k-j) + sum_l B_il y(k-l),   j = 1..p,   l = first..last

It is fitted to the increments u(k) - u(k-1): commands are large and smooth, and what tells the
laws apart is in their increments.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from lbt_synth.identification.records.faults import MAD, find_saturated
from lbt_synth.validation import BoolArray, FloatArray, IntArray

LAGS = range(-4, 5)  # frames by which the first measurement may be late
_CUTOFF = 1e-11  # of the largest singular value
_BLOCK = 2048  # rows of a triangular factor
_ALIKE = 3.0  # over the residual of the richest law, within which a simple one explains as much
_FLOOR = 1e-10  # part of the increments' variance that rounding may leave
_SAME = 1.05  # times the residual, within which a tap is idle
_SPARE = 0.2  # of what the richest law explains, that a simple one may leave
SHORT_ORDER = 3  # most past commands of a short law
_JUMP = 30.0  # median deviations
_MOST_JUMPS = 0.02  # of the frames
_ODD = 8.0  # deviations of a frame that follows another law
_ODD_FLOOR = 1e-3  # of the increments
_MOST_ODD = 0.1  # of the frames


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopSeries:
    """Measurements and commands of a loop, (frames, axes) each, and which of them are good."""

    measurements: FloatArray
    commands: FloatArray
    measured: BoolArray  # (frames,)
    commanded: BoolArray  # (frames,)
    followed: BoolArray  # (frames,): False where the command is no result of the law

    @property
    def axes(self) -> int:
        """Number of axes."""
        return int(self.commands.shape[1])

    def rows(self, order: int, lags: range) -> IntArray:
        """Return the frames k at which all values of a law are good."""
        frames = len(self.commands)
        start, stop = max(order, 1, lags[-1]), min(frames, frames + lags[0])
        if stop <= start:
            return np.zeros(0, dtype=np.int64)
        good = self.followed[start:stop].copy()
        for lag in range(max(order, 1) + 1):
            good &= self.commanded[start - lag : stop - lag]
        for lag in lags:
            good &= self.measured[start - lag : stop - lag]
        return start + np.flatnonzero(good)

    def odd_frames(self, past: FloatArray, taps: FloatArray, lags: range) -> BoolArray:
        """Return the frames that are far from a law, if they are few, (frames,)."""
        rows = self.rows(past.shape[1], lags)
        y, u = self.measurements, self.commands
        left = u[rows].copy()
        for j in range(past.shape[1]):
            left -= past[:, j] * u[rows - 1 - j]
        for index, lag in enumerate(lags):
            left -= y[rows - lag] @ taps[:, index].T
        left = np.abs(left - np.median(left, axis=0))
        floor = _ODD_FLOOR * np.std(u[rows] - u[rows - 1], axis=0)
        beyond = np.any(left > np.maximum(_ODD * MAD * np.median(left, axis=0), floor), axis=1)
        odd = np.zeros(len(u), dtype=np.bool_)
        if np.mean(beyond) < _MOST_ODD:
            odd[rows[beyond]] = True
        return odd


def prepare_series(
    y: FloatArray, u: FloatArray, measured: BoolArray, commanded: BoolArray | None
) -> LoopSeries:
    """Return the series of a loop, without the commands at a limit and those that jump."""
    return LoopSeries(
        measurements=y,
        commands=u,
        measured=measured,
        commanded=_without_limits(u, commanded),
        followed=_without_jumps(u),
    )


def _without_limits(u: FloatArray, good: BoolArray | None) -> BoolArray:
    """Return the frames whose commands are good and not at a limit, (frames,)."""
    free = np.ones(len(u), dtype=np.bool_) if good is None else good.copy()
    for series in u.T:
        free &= ~find_saturated(series, free)
    return free


def _without_jumps(u: FloatArray) -> BoolArray:
    """Return the frames whose commands do not jump, as at a reset, (frames,)."""
    size = np.abs(np.diff(u, axis=0, prepend=u[:1]))
    jumps = np.any(size > _JUMP * np.median(size, axis=0) + 1e-300, axis=1)
    return ~jumps if np.mean(jumps) < _MOST_JUMPS else np.ones(len(u), dtype=np.bool_)


class LawShape(NamedTuple):
    """Order of a law, and the lags of its first and last measurement [frames]."""

    order: int
    first: int
    last: int

    @property
    def lags(self) -> range:
        """Lags of the measurements."""
        return range(self.first, self.last + 1)


class LawCoefficients(NamedTuple):
    """Coefficients of a law, with the covariance of its taps."""

    past: FloatArray  # (axes, order): a_ij
    taps: FloatArray  # (axes, lags, axes): B_il
    past_error: FloatArray  # (axes,): error of the sum of a_ij
    taps_covariance: FloatArray  # (axes, lags axes, lags axes)


class Regression:
    """Triangular factor of the increments and of all that may explain them."""

    def __init__(self, series: LoopSeries, order: int, lags: range, most_rows: int) -> None:
        """Factorise ``most_rows`` frames at most, evenly spread."""
        rows = series.rows(order, lags)
        if rows.size > most_rows:
            rows = rows[np.linspace(0, rows.size - 1, most_rows).astype(np.int64)]
        self.order, self.lags, self.axes, self.rows = order, lags, series.axes, rows.size
        y, u = series.measurements, series.commands
        increments = np.diff(u, axis=0, prepend=u[:1])
        parts = [increments[rows], u[rows - 1]]
        parts += [increments[rows - lag] for lag in range(1, order)]
        parts += [y[rows - lag] for lag in lags]
        table = np.concatenate(parts, axis=1)
        table -= table.mean(axis=0)
        self._scale = np.maximum(np.sqrt(np.mean(table**2, axis=0)), 1e-300)
        self._factor = _triangular_factor(table / self._scale)
        self.variance = self._scale[: self.axes] ** 2  # of the increments

    def _past(self, axis: int, order: int) -> list[int]:
        return [axis + self.axes * (1 + lag) for lag in range(order)]

    def _taps(self, lags: range) -> list[int]:
        first = self.axes * (1 + self.order + lags[0] - self.lags[0])
        return list(range(first, first + self.axes * len(lags)))

    def _target(self, axis: int, order: int) -> FloatArray:
        """Return the increment in units of its own rms; a law without memory has the command."""
        target = self._factor[:, axis]
        if order:
            return target
        past = axis + self.axes
        return np.asarray(target + self._factor[:, past] * self._scale[past] / self._scale[axis])

    def _solve(self, axis: int, chosen: list[int], target: FloatArray) -> tuple[FloatArray, float]:
        if not chosen:
            return np.zeros(0), float(target @ target) / self.rows
        table = self._factor[:, chosen]
        found = np.linalg.lstsq(table, target, rcond=_CUTOFF)[0]
        left = target - table @ found
        return found * self._scale[axis] / self._scale[chosen], float(left @ left) / self.rows

    def residuals(self, shape: LawShape) -> FloatArray:
        """Return the part of the increments' variance that a law leaves of each moving axis."""
        left = [
            self._solve(
                axis,
                self._past(axis, shape.order) + self._taps(shape.lags),
                self._target(axis, shape.order),
            )[1]
            for axis in self.moving
        ]
        return np.array(left)

    def residual(self, shape: LawShape) -> float:
        """Return the mean of that over the axes."""
        return float(np.mean(self.residuals(shape)))

    @property
    def moving(self) -> list[int]:
        """Axes whose commands move at all."""
        return [axis for axis in range(self.axes) if self.variance[axis] > 1e-30]

    def coherence(self, shape: LawShape) -> FloatArray:
        """Return the part of what past commands leave that a law explains, of each axis (axes,).

        Corrected for the number of coefficients; zero where commands do not move.
        """
        out = np.zeros(self.axes)
        used = shape.order + self.axes * len(shape.lags)
        for axis, after in zip(self.moving, self.residuals(shape), strict=True):
            _, before = self._solve(axis, self._past(axis, self.order), self._factor[:, axis])
            if before > 0:
                ratio = after / before * (self.rows - self.order) / (self.rows - used)
                out[axis] = max(0.0, 1 - float(ratio))
        return out

    def most_residual(self, lags: range = LAGS) -> float:
        """Return what a simple law may leave, to explain as much as the richest one."""
        richest = self.residual(LawShape(self.order, lags[0], self.lags[-1]))
        return min(_ALIKE * richest, richest + _SPARE * (1 - richest)) + _FLOOR

    def coefficients(self, shape: LawShape) -> LawCoefficients:
        """Return the coefficients of a law, and their errors."""
        count, lags = shape.order, len(shape.lags)
        past, errors = np.zeros((self.axes, count)), np.zeros(self.axes)
        taps = np.zeros((self.axes, lags, self.axes))
        spread = np.zeros((self.axes, lags * self.axes, lags * self.axes))
        for axis in self.moving:
            chosen = self._past(axis, count) + self._taps(shape.lags)
            found, left = self._solve(axis, chosen, self._target(axis, count))
            taps[axis] = found[count:].reshape(lags, self.axes)
            if count:
                steps = np.append(found[1:count], 0.0)  # of the increments before
                past[axis] = np.diff(steps, prepend=0.0)
                past[axis, 0] += 1 + found[0]
            spare = max(self.rows - len(chosen), 1)
            inverse = np.linalg.pinv(self._factor[:, chosen], rcond=_CUTOFF)
            scale = self._scale[axis] / self._scale[chosen]
            half = scale[:, None] * inverse * np.sqrt(left * self.rows / spare)
            spread[axis] = half[count:] @ half[count:].T
            errors[axis] = float(np.linalg.norm(half[0])) if count else 0.0
        return LawCoefficients(past, taps, errors, spread)


def _triangular_factor(table: FloatArray) -> FloatArray:
    """Return R of the QR factorisation of a tall table, block by block."""
    whole = len(table) // _BLOCK * _BLOCK
    parts = [table[whole:]]
    if whole and table.shape[1] < _BLOCK:
        blocks = np.asarray(np.linalg.qr(table[:whole].reshape(-1, _BLOCK, table.shape[1]), "r"))
        parts.append(blocks.reshape(-1, table.shape[1]))
    elif whole:
        parts.append(table[:whole])
    return np.asarray(np.linalg.qr(np.concatenate(parts), mode="r"))


def _lowest(regression: Regression, order: int, more: int, lags: range) -> tuple[float, LawShape]:
    """Return the best law of an order and a number of taps, over the lags of the first."""
    shapes = (LawShape(order, lag, lag + more) for lag in lags)
    found = [(regression.residual(each), each) for each in shapes]
    return min(found)


def simplest_short_law(regression: Regression, lags: range = LAGS) -> LawShape | None:
    """Return the shortest law of up to three states that explains as much as the richest one."""
    most = regression.most_residual(lags)
    for order, more in product(range(SHORT_ORDER + 1), repeat=2):
        if not order - 1 <= more <= order:
            continue
        left, shape = _lowest(regression, order, more, lags)
        if left <= most:
            return _without_idle_taps(regression, left, shape)
    return None


def simplest_law(regression: Regression, lags: range = LAGS) -> LawShape:
    """Return the shortest law that explains as much as the richest one."""
    if found := simplest_short_law(regression, lags):
        return found
    most, below = regression.most_residual(lags), SHORT_ORDER
    left, shape = 1.0, LawShape(regression.order, 0, regression.order)
    order = below
    while order < regression.order:
        below, order = order, min(2 * order, regression.order)
        left, shape = _lowest(regression, order, order, lags)
        if left <= most:
            return _lower_order(regression, left, shape, below, most)
    return _without_idle_taps(regression, left, shape)


def _lower_order(
    regression: Regression, left: float, shape: LawShape, below: int, most: float
) -> LawShape:
    """Return the law of the least order above ``below``, without idle taps."""
    shape = _without_idle_taps(regression, left, shape)
    for order in range(below + 1, shape.order):
        shorter = LawShape(order, shape.first, min(shape.first + order, shape.last))
        if regression.residual(shorter) <= most:
            return shorter
    return shape


def _without_idle_taps(regression: Regression, left: float, shape: LawShape) -> LawShape:
    """Return the law without the first and last taps that explain nothing."""
    most = _SAME * left + _FLOOR
    for early, late in ((1, 0), (0, -1)):
        while shape.first < shape.last:
            shorter = LawShape(shape.order, shape.first + early, shape.last + late)
            if regression.residual(shorter) > most:
                break
            shape = shorter
    return shape
