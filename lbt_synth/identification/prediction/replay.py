"""Loops replayed on recorded series: where they start, and what the start may still add.

The state of a loop at the beginning of contiguous frames depends on the frames before, which are
not known. A replay begins in the equilibrium for the mean of the first frames. An error d of that
state adds ``C A^k d`` to the residual of frame k. Its covariance P is that of the loop's state
under the record's own sample autocovariance: with s(k) the state on the N frames, less that
mean, from rest, and then on zeros for ever,

    P = (1 / N) sum over all k of s(k) s(k)'

From frame a to frame b the start then adds ``(1 / (b - a)) sum C A^k P A'^k C'`` to the mean
square. A loop warms up on the frames before the test, and on as many of its first frames as make
the error of the residual least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import rfft

from lbt_synth.errors import ProblemError
from lbt_synth.identification.stretches import Stretches
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.loop import ClosedLoop
from lbt_synth.validation import ComplexArray, FloatArray

FEWEST = 100  # frames that give a standard error
_FIRST = 64  # frames whose mean a replay begins with
_MOST_STATES = 1 << 15  # frames of a stretch that show the spread of the state
_TINY = 1e-300


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayFrames:
    """Frames that count, in the contiguous frames that a replay runs over."""

    runs: Stretches  # contiguous frames
    test: Stretches  # frames of them that count

    @property
    def starts(self) -> tuple[int, ...]:
        """First frame of the run of each stretch of the test."""
        return tuple(max(a for a, _ in self.runs if a <= start) for start, _ in self.test)

    @property
    def count(self) -> int:
        """Number of frames that count."""
        return sum(stop - start for start, stop in self.test)

    def without(self, frames: int) -> ReplayFrames:
        """Return the test without the first frames of each run."""
        begins = zip(self.starts, self.test, strict=True)
        kept = [(max(start, first + frames), stop) for first, (start, stop) in begins]
        return replace(self, test=tuple((a, b) for a, b in kept if a < b))


def replay_frames(runs: Stretches, test: Stretches) -> ReplayFrames:
    """Check that a test lies in contiguous frames."""
    for start, stop in test:
        if not any(a <= start and stop <= b for a, b in runs):
            raise ProblemError(
                f"the test must lie within the usable stretches; got ({start}, {stop}) in "
                f"{', '.join(map(str, runs))}."
            )
    found = ReplayFrames(runs=runs, test=test)
    if found.count < FEWEST:
        raise ProblemError(
            f"a residual needs at least {FEWEST} frames; got {found.count}. Record more."
        )
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replay:
    """What a loop leaves of recorded frames, and what the error of its start adds.

    A loop without states that are unknown, such as one that was measured, has no ``spread``.
    """

    residual: FloatArray  # (frames, n): the measured residual; nan outside the runs
    output: FloatArray  # (n, s): C
    powers: tuple[FloatArray, ...] = ()  # (s, s) each: A, A^2, A^4, ...
    spread: FloatArray | None = None  # (s, s): sum of A^k P A'^k over all k

    def measured(self, frames: ReplayFrames) -> FloatArray:
        """Return the measured residual of the frames that count, (k, n)."""
        return np.concatenate([self.residual[start:stop] for start, stop in frames.test])

    def scatter(self, frames: ReplayFrames) -> float:
        """Return the standard error of the mean square over all axes, but for the start."""
        e = self.measured(frames)
        return float(np.sqrt(max(np.sum(mean_covariance(e, e, frames.test)), 0.0)))

    def left_of_start(self, frames: ReplayFrames) -> FloatArray:
        """Return the mean square that the start adds to the test, (n, n)."""
        n = len(self.output)
        total = np.zeros((n, n))
        for first, (start, stop) in zip(frames.starts, frames.test, strict=True):
            total += self._energy_after(start - first) - self._energy_after(stop - first)
        return total / frames.count

    def _energy_after(self, frames: int) -> FloatArray:
        """Return the sum of the squares that the start adds from a frame on, (n, n)."""
        row = self.output
        for i, power in enumerate(self.powers):
            if frames >> i & 1:
                row = row @ power
        return row @ self.spread @ row.T if self.spread is not None else 0 * row @ row.T


def measured_replay(residual: FloatArray) -> Replay:
    """Return the residual that a loop measured as a replay that needs no start."""
    n = residual.shape[1]
    return Replay(residual=residual, output=np.zeros((n, 0)))


def replay(loop: ClosedLoop, series: FloatArray, runs: Stretches, *, from_rest: bool) -> Replay:
    """Replay a stable loop on a recorded series (frames, n)."""
    # z(k) for phi_tot(k-1), and no noise: the residual of frame k-1 is e(k)
    path = loop.rejection()
    s, n = path.B.shape
    equilibrium = np.linalg.solve(np.eye(s) - path.A, path.B)
    constant = path.C @ equilibrium + path.D  # what the loop leaves of a constant
    both = replace(path, C=np.vstack([path.C, np.eye(s)]), D=np.vstack([path.D, np.zeros((s, n))]))
    residual = np.full(series.shape, np.nan)
    moments, count = np.zeros((s, s)), 0
    for start, stop in runs:
        mean = np.zeros(n) if from_rest else np.mean(series[start : min(stop, start + _FIRST)], 0)
        away = series[start:stop] - mean
        residual[start:stop] = filter_series(path, away) + constant @ mean
        if not from_rest:
            away = away[:_MOST_STATES]
            states = filter_series(both, away)[:, n:]
            last = path.A @ states[-1] + path.B @ away[-1]
            moments += states.T @ states
            moments += stationary_covariance(path.A, np.outer(last, last))
            count += len(away)
    if from_rest:
        return Replay(residual=residual, output=path.C)
    powers = [path.A]
    for _ in range(len(series).bit_length()):
        powers.append(powers[-1] @ powers[-1])
    return Replay(
        residual=residual,
        output=path.C,
        powers=tuple(powers),
        spread=stationary_covariance(path.A, moments / count),
    )


def choose_warm_up(replays: Sequence[Replay], frames: ReplayFrames) -> int:
    """Return the frames at the beginning of each run that are better left out.

    It is the number for which the variances of the mean squares, by the scatter of the residual
    and by its start, have the least sum over the replays, in units of the first.
    """
    longest = max(stop - start for start, stop in frames.runs)
    tried = [0, *np.unique(np.geomspace(1, longest, 60).astype(int)).tolist()]
    kept = [(w, part) for w in tried if (part := frames.without(w)).count >= FEWEST]
    adds = np.array([[np.trace(one.left_of_start(part)) for one in replays] for _, part in kept])
    share = np.array([frames.count / part.count for _, part in kept])
    best = 0
    for _ in range(2):  # the first scatter has the start in it
        scatter = np.array([one.scatter(kept[best][1]) for one in replays])
        scatter /= np.sqrt(share[best])
        variances = len(replays) * share + np.sum((adds / np.maximum(scatter, _TINY)) ** 2, axis=1)
        best = int(np.argmin(variances))
    return int(kept[best][0])


def mean_covariance(one: FloatArray, other: FloatArray, stretches: Stretches) -> FloatArray:
    """Return the covariance over the axes of mean products of two Gaussian series, (n, n).

    Over K frames it is ``2 / K`` times the sum of the squared cross-covariances over all lags
    (M. S. Bartlett, J. Roy. Stat. Soc. Suppl. 8, 27 (1946), doi:10.2307/2983611). A periodogram I
    has ``E I^2 = 2 S^2``: no spectrum needs to be smoothed.

    ``cov(x_i y_i, x_j y_j)`` over all lags is the mean over the frequencies of ``S(x_i, x_j)
    conj S(y_i, y_j) + S(x_i, y_j) conj S(y_i, x_j)``. On the diagonal the product of the two
    periodograms has that mean for x = y, and at least that otherwise; off it, the two factors
    are taken at neighbouring frequencies, which are independent.
    """
    frames, n = one.shape
    total, start = np.zeros((n, n)), 0
    for begin, end in stretches:
        length = end - begin
        x, y = (rfft(series[start : start + length], axis=0) for series in (one, other))
        weight = np.full(len(x), 2.0)  # a frequency and its negative
        weight[0] = 1.0
        weight[-1] = 2.0 if length % 2 else 1.0
        weight /= length**2
        part = _products(x, x) * np.roll(_products(y, y).conj(), 1, axis=0)
        part += _products(x, y) * np.roll(_products(y, x).conj(), 1, axis=0)
        lower = np.tril(np.tensordot(weight, part.real, 1), -1)
        total += lower + lower.T + np.diag(weight @ (np.abs(x) ** 2 * np.abs(y) ** 2))
        start += length
    total /= frames**2
    # a covariance is at most the product of the deviations
    most = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    return np.asarray(np.clip(total, -most, most))


def _products(x: ComplexArray, y: ComplexArray) -> ComplexArray:
    """Return ``x_i conj(y_j)`` at each frequency, (f, n, n)."""
    return x[:, :, None] * y.conj()[:, None, :]
