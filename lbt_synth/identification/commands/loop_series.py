"""The series that a control law is fitted to, without frames that no law explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.identification.records.faults import find_saturated
from lbt_synth.validation import BoolArray, FloatArray, IntArray

_JUMP = 30.0  # median deviations
_MOST_JUMPS = 0.02  # of the frames
_MAD = 1.4826  # standard deviation of a normal law over its median deviation
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
        beyond = np.any(left > np.maximum(_ODD * _MAD * np.median(left, axis=0), floor), axis=1)
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
