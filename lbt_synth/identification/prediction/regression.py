"""The least-squares predictor of a record: what past readings tell beyond a model.

The base is the Kalman filter of the model. Its correction, the pseudo-open-loop measurement and the
channels of accelerometers, each over the last frames, are regressed on what the base leaves. The
penalty is chosen by forward chaining: filters of the past are judged on what comes next. With a
large penalty the predictor is the base. A regression is made of its moments alone, so that parts
of a record, and signals that are left out, cost no second look at the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import accumulate, pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lbt_synth.design.kalman import kalman
from lbt_synth.design.predictor import PredictorDesign, predictor_design, regression_filter
from lbt_synth.design.shaping.channel import held_fraction
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.identification.accelerometers.readings import Channels
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.prediction.residual import gather, run_from_rest, settle_frames
from lbt_synth.identification.records.record import (
    LoopRecord,
    Stretches,
    cut_stretches,
    split_halves,
)
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop
from lbt_synth.models import LoopHardware
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import FloatArray, IntArray

TAPS = 64  # frames of the past: at 1 kHz two periods of a line at 30 Hz, below which the base is
_PENALTIES = 10.0 ** np.arange(-9, 4)  # of a coefficient whose signal changes by 1 a frame
_USUAL = 5  # place of the penalty where a search begins
_PARTS = 6  # of a record, of which each is predicted by those before, from the third on
_FIRST = 2
_REMOTE = 16.0  # frames, from which on a penalty grows with age: old readings tell least


def noisier(model: IdentifiedModel, added_nm: FloatArray | float) -> IdentifiedModel:
    """Return a model with more noise, as phase of each axis (n,) or of all [nm]."""
    phases_nm = np.broadcast_to(added_nm, len(model.axes)).tolist()
    axes = (
        replace(axis, noise_nm=float(np.hypot(axis.noise_nm, phase_nm * axis.sensor_gain)))
        for axis, phase_nm in zip(model.axes, phases_nm, strict=True)
    )
    return replace(model, axes=tuple(axes))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moments:
    """Sums over frames of products of lagged signals, and of these with targets."""

    squares: FloatArray  # (taps m, taps m), the newest first
    products: FloatArray  # (taps m, n)
    targets: FloatArray  # (n,)
    frames: int

    def __add__(self, other: Moments) -> Moments:
        """Return the moments of both."""
        names = ("squares", "products", "targets", "frames")
        return Moments(**{name: getattr(self, name) + getattr(other, name) for name in names})

    def chosen(self, places: IntArray) -> Moments:
        """Return the moments of some signals alone."""
        squares = self.squares[np.ix_(places, places)]
        return replace(self, squares=squares, products=self.products[places])

    def left(self, coefficients: FloatArray) -> float:
        """Return the mean square that coefficients (taps m, n) leave of the targets, summed."""
        taken = 2 * self.products - self.squares @ coefficients
        return float(np.sum(self.targets) - np.sum(coefficients * taken)) / self.frames


def lagged_moments(signals: FloatArray, targets: FloatArray, runs: Stretches, taps: int) -> Moments:
    """Return the moments of signals (frames, m) and their past, and of targets (frames, n).

    Beside the lags with the newest value, each product of two lags is that of a frame earlier, less
    the last frame of the run and with one before it.
    """
    (_, m), n = signals.shape, targets.shape[1]
    squares, products = np.zeros((taps, taps, m, m)), np.zeros((taps, m, n))
    for start, stop in runs:
        late = [signals[start - lag : stop - lag] for lag in range(taps)]
        newest = np.stack([late[0].T @ other for other in late])
        before = signals[start - 1 - np.arange(taps)]
        last = signals[stop - 1 - np.arange(taps)]
        block = np.empty_like(squares)
        block[0], block[:, 0] = newest, newest.transpose(0, 2, 1)
        for i in range(1, taps):
            entered = before[i - 1, None, :, None] * before[i - 1 : taps - 1, None, :]
            gone = last[i - 1, None, :, None] * last[i - 1 : taps - 1, None, :]
            block[i, i:] = block[i - 1, i - 1 : taps - 1] + entered - gone
            block[i:, i] = block[i, i:].transpose(0, 2, 1)
        squares += block
        products += np.stack([other.T @ targets[start:stop] for other in late])
    square = squares.transpose(0, 2, 1, 3).reshape(taps * m, taps * m)
    kept = [targets[start:stop] for start, stop in runs]
    return Moments(
        squares=square,
        products=products.reshape(taps * m, n),
        targets=np.sum([np.sum(part**2, axis=0) for part in kept], axis=0),
        frames=sum(len(part) for part in kept),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Regression:
    """What a record tells of the future, beside its model.

    Attributes
    ----------
    hardware : LoopHardware
        The loop with the sensors that are read.
    base : Controller
        The Kalman filter of the model, of the loop's own sensor.
    readings : (frames, q + c) ndarray
        Pseudo-open-loop measurements and channels of the frames that count.
    parts : tuple of Moments
        Moments of consecutive parts of the record.
    scales : (m,) ndarray
        Changes of each signal from frame to frame, rms.
    groups : tuple of tuple of int
        Axes whose filters read each other: all of them, or each by itself.
    """

    hardware: LoopHardware
    base: Controller
    readings: FloatArray
    parts: tuple[Moments, ...]
    scales: FloatArray
    groups: tuple[tuple[int, ...], ...]

    @property
    def own(self) -> int:
        """Number of signals of the loop's own sensor: the base's corrections and measurements."""
        return 2 * self.hardware.modes

    def places(self, signals: Sequence[int]) -> IntArray:
        """Return where some signals stand in the moments, all lags."""
        rows = np.arange(TAPS)[:, None] * len(self.scales) + np.array(signals)
        return np.asarray(rows.ravel())

    def read_by(self, axes: Sequence[int], signals: Sequence[int]) -> list[int]:
        """Return which of some signals a group of axes reads: its own, and channels."""
        modes = self.hardware.modes
        return [signal for signal in signals if signal >= self.own or signal % modes in axes]

    def _weights(self, signals: Sequence[int]) -> FloatArray:
        """Return the matrix of the penalty of some signals: of age and offsets of channels, too."""
        scale, age = self.scales[list(signals)], np.arange(TAPS) / _REMOTE
        weights = np.diag(np.outer((1 + age**2) ** 2, scale**2).ravel())
        for place, signal in enumerate(signals):
            if signal >= self.own:
                rows = place + len(signals) * np.arange(TAPS)
                # readings may stand off zero by their rms change a frame
                weights[np.ix_(rows, rows)] += scale[place] ** 2
        return weights

    def _factor(
        self, signals: Sequence[int], penalty: float, moments: Moments
    ) -> tuple[FloatArray, tuple[FloatArray, bool]]:
        """Return the matrix of a penalty of signals, and the factor of their squares with it."""
        weights = penalty * moments.frames * self._weights(signals)
        try:
            return weights, cho_factor(moments.squares + weights)
        except np.linalg.LinAlgError:
            raise NumericalError(
                "the past readings of a record depend on each other; expected some noise in them.",
                status="regression",
            ) from None

    def solve(self, signals: Sequence[int], penalty: float, moments: Moments) -> FloatArray:
        """Return the coefficients of some signals, (taps m, n), for moments of these."""
        coefficients = np.zeros_like(moments.products)
        for axes in self.groups:
            read = self.read_by(axes, signals)
            places, columns = np.flatnonzero(np.tile(np.isin(signals, read), TAPS)), np.array(axes)
            chosen = moments.chosen(places)
            solved = cho_solve(self._factor(read, penalty, chosen)[1], chosen.products[:, columns])
            coefficients[np.ix_(places, columns)] = solved
        return coefficients

    def fit_share(self, penalty: float) -> float:
        """Return by which share of what it leaves the filter of all signals is worse unseen.

        Its effective number of coefficients over the frames: what their errors add (H. Akaike, Ann.
        Inst. Statist. Math. 21, 243 (1969), doi:10.1007/BF02532251).
        """
        counts, left_nm2 = [], [np.sum(self.whole.targets[list(axes)]) for axes in self.groups]
        for axes in self.groups:
            read = self.read_by(axes, range(len(self.scales)))
            weights, factor = self._factor(read, penalty, self.whole.chosen(self.places(read)))
            inverse = cho_solve(factor, np.eye(len(weights)))
            counts.append(len(weights) - np.sum(inverse * weights))
        return float(np.average(counts, weights=left_nm2)) / self.whole.frames

    @cached_property
    def whole(self) -> Moments:
        """Moments of all frames."""
        return sum(self.parts[1:], self.parts[0])

    @cached_property
    def penalty(self) -> float:
        """The penalty whose filters of the past leave least of what comes next."""
        signals, pasts = range(len(self.scales)), [*accumulate(self.parts)][_FIRST - 1 : -1]

        @cache
        def left(i: int) -> float:
            return sum(
                part.left(self.solve(signals, _PENALTIES[i], past))
                for past, part in zip(pasts, self.parts[_FIRST:], strict=True)
            )

        least, before = _USUAL, -1
        while least != before:  # downhill: no record has two minima that differ by 1 %
            before, ends = least, (max(least - 1, 0), min(least + 2, len(_PENALTIES)))
            least = min(range(*ends), key=left)
        return float(_PENALTIES[least])

    def design(self, penalty: float | None = None) -> PredictorDesign:
        """Return the certified design, by default with the penalty of forward chaining."""
        everything, own = range(len(self.scales)), range(self.own)
        penalty = self.penalty if penalty is None else penalty
        path, filters, left = self.hardware.own_sensor_alone(), list[Controller](), list[float]()
        for signals in (everything, own)[: 1 + bool(self.hardware.suite.sensors)]:
            moments = self.whole.chosen(self.places(signals))
            coefficients = self.solve(signals, penalty, moments)
            shaped = coefficients.reshape(TAPS, len(signals), -1).transpose(0, 2, 1)
            filters.append(regression_filter(path, self.base, shaped))
            left.append(moments.left(coefficients))
        return predictor_design(
            self.hardware,
            filters,
            self.readings,
            left[0],
            groups=self.groups,
            what=f"penalty {penalty:.0e}",
            fit_share=self.fit_share(penalty),
        )


def regress(
    record: LoopRecord,
    model: IdentifiedModel,
    *,
    channels: Channels | None = None,
    added_nm: FloatArray | float = 0.0,
    separate: bool = False,
) -> Regression:
    """Collect what a record tells of its future, beside its model, of which the base is the filter.

    If they are separate, as in the model, no axis reads the measurements of the other.

    More noise than the model's, as phase of each axis, is added as that of a run without any
    disturbance, of which nothing is to be corrected.
    """
    path = model.hardware
    if len(path.influence) != path.n_commands:
        raise ProblemError("a predictor needs a command for every mode; got fewer.")
    runs = record.stretches()
    base = kalman(noisier(model, added_nm).plant()).controller
    series = record.pseudo_open_loop(model.sensor_gains)
    steering = close_loop(path, base).path("phase", "command")
    late, taps = held_fraction(path), path.mirror_taps
    if late:  # the target of a command is the mean phase of its hold, which lies in two frames
        taps = np.eye(1, path.mirror_system.lead + 1, path.mirror_system.lead)[0]
    first, axes = max(TAPS + len(taps), settle_frames(path)), range(path.modes)
    beside = np.zeros((record.frames, 0)) if channels is None else channels.values

    def lay(series: FloatArray, runs: Stretches, beside: FloatArray) -> tuple[FloatArray, ...]:
        """Return signals, what the base leaves of the targets, series and targets, 0 outside."""
        commands = run_from_rest(steering, series, runs, first)  # u(k-1) in row k
        inside = np.isfinite(commands[:, :1])
        seen, moved = np.where(inside, series, 0.0), np.where(inside, commands, 0.0)
        target = late * np.vstack([seen[1:], seen[-1:]]) + (1 - late) * seen
        moved = np.vstack([moved[1:], moved[-1:]]) @ path.influence.T
        corrected = past_corrections(taps, moved)
        past = past_corrections(taps, np.hstack([seen, beside]))
        return np.hstack([corrected, past]), target - corrected, seen, target

    signals, left, seen, _ = lay(series, runs, beside)
    readings = np.hstack([seen @ path.sensor.T, beside])
    end = bool(late)  # whose target is beyond the run
    kept = tuple((start + first, stop - end) for start, stop in runs if stop - start > first + end)
    count = sum(stop - start for start, stop in kept)
    if count < 2 * TAPS * _PARTS:
        raise ProblemError(
            f"a predictor needs {2 * TAPS * _PARTS} frames beyond the first {first} of each "
            f"stretch; got {count}. Record for longer."
        )
    edges = [count * part // _PARTS for part in range(_PARTS + 1)]
    parts = [cut_stretches(kept, a, b) for a, b in pairwise(edges)]
    changes = np.concatenate([np.diff(signals[start:stop], axis=0) for start, stop in kept])
    scales = np.sqrt(np.mean(changes**2, axis=0))
    moments = [lagged_moments(signals, left, part, TAPS) for part in parts]
    if np.any(added_nm):
        drawn = added_nm * np.random.default_rng(1).standard_normal((count + first, path.modes))
        silence = np.zeros((len(drawn), beside.shape[1]))
        heard, left, _, target = lay(drawn, ((0, len(drawn)),), silence)
        for place, (a, b) in enumerate(pairwise(edges)):
            more = lagged_moments(heard, left - target, ((first + a, first + b),), TAPS)
            moments[place] += replace(more, frames=0)
    return Regression(
        hardware=path if channels is None else channels.hardware(path),
        base=base,
        readings=gather(readings, kept),
        parts=tuple(moments),
        scales=np.where(scales > 0, scales, 1.0),
        groups=tuple((i,) for i in axes) if separate else (tuple(axes),),
    )


@table_row
class ChannelValue:
    """What a predictor leaves of unseen frames without a channel, and if it reads zeros."""

    channel: str = column("channel")
    without_nm: float = nm_column("without it", unit="nm rms")
    dead_nm: float = nm_column("zeros, unseen", unit="nm rms")


def channel_values(
    record: LoopRecord, half: IdentifiedModel, channels: Channels
) -> tuple[ChannelValue, ...]:
    """Return what a predictor of the first half leaves of the second, without each channel.

    The noise of the measurements is subtracted; nan where it hides the residual.
    """
    past, unseen = (regress(frames, half, channels=channels) for frames in split_halves(record))
    noise_nm2 = sum((axis.noise_nm / axis.sensor_gain) ** 2 for axis in half.axes)
    everything = list(range(len(past.scales)))
    coefficients = past.solve(everything, past.penalty, past.whole)

    def left_nm(signals: list[int], coefficients: FloatArray) -> float:
        moments = unseen.whole.chosen(unseen.places(signals))
        left_nm2 = moments.left(coefficients) - noise_nm2
        return float(np.sqrt(left_nm2)) if left_nm2 > 0 else float("nan")

    rows = []
    for signal, name in zip(everything[past.own :], channels.names, strict=True):
        others = [other for other in everything if other != signal]
        without = past.solve(others, past.penalty, past.whole.chosen(past.places(others)))
        silent = coefficients.copy()
        silent[past.places([signal])] = 0.0
        without_nm, dead_nm = left_nm(others, without), left_nm(everything, silent)
        rows.append(ChannelValue(channel=name, without_nm=without_nm, dead_nm=dead_nm))
    return tuple(rows)
