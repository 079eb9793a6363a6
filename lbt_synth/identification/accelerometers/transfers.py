"""How each channel of accelerometers moves with each line of an identified model.

Readings are laid beside the wavefront, and fitted there. They may lag behind it by some frames. A
shift turns the phase of every frequency in proportion. Within a narrow line that slope is hard to
see. Over several lines it is seen well if the channels move with or against the wavefront, phases 0
or 180 degrees, as parts of a stiff structure do. That is tested, not assumed: where the phases
differ, or another shift explains them as well, only the slope within the lines counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.fallbacks import MOST_UNITS
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.accelerometers.line_bands import (
    NM,
    BandFit,
    LineBand,
    fit_band,
    line_bands,
)
from lbt_synth.identification.accelerometers.readings import as_columns, fill_missing
from lbt_synth.identification.fit.identified_model import IdentifiedLine, IdentifiedModel
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT
from lbt_synth.identification.records.faults import runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches
from lbt_synth.models.sensor_suite import LONGEST_DELAY
from lbt_synth.storage.rows import column, row_table, table_row
from lbt_synth.storage.tables import Table
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, number

_TINY = 1e-300
_EXTRA = f"left out, because others show more and a design takes {MOST_UNITS - 1} channels"
_FEWEST_VALUES = 4  # a series of no more different numbers is rounding
_ROUNDING = 1e-12  # of the largest number
_LEAST_M_S2 = 1e-6  # far below what any accelerometer resolves
_PASSES = 3
_NEAR_S = 1.0  # within which a shift is refined
_ROUNDS = 3  # in which the skirts of strong lines leave the bands of others
_STEP = 0.5  # frames
_FINE = 0.01
_RIVAL = 6.9  # of the logarithm of the likelihood: 1000 times less likely
_CHANCE = 1e-3  # of phases as far from 0 and 180 degrees
_TURN = 0.3  # rad, of the edges of a band from one lag that is tried to the next
_CLEARLY = 10.0  # by which a shift must be likelier than none before readings are moved by it

Pair = tuple[LineBand, BandFit, int, int]  # band, fit of the channel, line of the band, channel
Shift = tuple[float, float, bool]  # frames, standard error, whether phases of lines give it


@table_row
class TransferRow:
    """How one channel moves with one line."""

    channel: str = column("channel", help="Name of the channel")
    line: int = column(help="Index of the line among the resonances of the model")
    frequency_hz: float = column("f", unit="Hz", format=".3f", help="Frequency of the line")
    motion_nm_per_nm: float = column(
        "motion",
        unit="nm/nm",
        format=".4g",
        help="Motion of the channel per motion of the wavefront",
    )
    motion_error_nm_per_nm: float = column(
        "+-", unit="nm/nm", format=".2g", help="Standard error of the motion"
    )
    phase_deg: float = column(
        "phase", unit="deg", format=".1f", help="Phase of the motion against that of the wavefront"
    )
    phase_error_deg: float = column(
        "+-", unit="deg", format=".2g", help="Standard error of the phase"
    )
    coherence: float = column(
        "coherence",
        format=".3f",
        help="Share of the power at the line that goes with the wavefront",
    )
    chance: float = column(
        "chance", format=".1g", help="Probability that a channel without the line shows as much"
    )
    useful: bool = column("used", help="Whether the line shows in the channel beyond chance")


@table_row
class ChannelRow:
    """One channel of the accelerometers."""

    channel: str = column("channel", help="Name of the channel")
    noise_m_s2: float = column(
        "noise",
        unit="m/s^2",
        format=".3g",
        help="Noise of a reading, near the lines it is used for",
    )
    verdict: str = column("verdict", help="What it is used for, or what is wrong with it")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AccelerometerTransfers:
    """What accelerometers show of the lines of a model."""

    # each channel with each line, in the convention of the model's configuration
    transfers: tuple[TransferRow, ...]
    channels: tuple[ChannelRow, ...]  # each channel with its noise and a verdict
    # by how many frames the readings, as they were given, lag behind the wavefront's measurement of
    # the same frame; above 0 if they come late
    shift_frames: float
    shift_error_frames: float  # standard error; infinite without any line
    # whether phases of several lines give it, or the slope of the phase within lines
    shift_by_phases: bool
    # age of a reading for which the phases hold; 1 is the wavefront's of the same frame
    age_frames: int
    rate_hz: float  # readings per second, after averaging

    @property
    def used(self) -> tuple[ChannelRow, ...]:
        """The channels that show a line."""
        names = {row.channel for row in self.transfers if row.useful}
        return tuple(row for row in self.channels if row.channel in names)

    def loop_age(self, delay_frames: float) -> int:
        """Return the age of a reading in a loop of some delay: 1 where the clocks hide it."""
        known = self.age_frames >= 0 and 1 <= self.age_frames + delay_frames - 1 <= LONGEST_DELAY
        return self.age_frames if known else 1

    @property
    def shift_text(self) -> str:
        """The shift of the clocks in words."""
        if not self.used:
            return (
                "no channel shows a line, so the clocks were not compared. If lines should show, "
                "check the rate of the readings, and when they began (accelerometer_rate_hz)."
            )
        size = f"{self.shift_frames:.3g} +- {self.shift_error_frames:.2g} frames"
        if self.shift_by_phases:
            return f"the accelerometers lag behind the wavefront by {size}, by the phases of lines."
        return (
            f"the phases of the lines do not tell the shift of the clocks from motions out of "
            f"phase; the slope within the lines says {size}. Phases hold for a shift of "
            f"{self.age_frames - 1}."
        )

    def tables(self) -> list[Table]:
        """Return the tables of lines and channels."""
        return [
            row_table("Accelerometers and lines", list(self.transfers)),
            row_table("Accelerometers", list(self.channels)),
        ]


def accelerometer_transfers(
    model: IdentifiedModel,
    record: LoopRecord,
    accelerations: ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    false_alarm: float = 1e-3,
    largest_shift_s: float = 10.0,
) -> AccelerometerTransfers:
    r"""Find how the channels of accelerometers move with the lines of an identified model.

    A channel c reads, in frame k of the loop,

    ``a_c(k) = 1e-9 sum_j F_cj a_j(k-g) + noise``

    with a_j(k) the mean acceleration of the line j [nm/s^2 of wavefront] over frame k, which is
    ``-(2 pi f)^2`` times the mean position in it, g the age of the reading, and F_cj a complex
    factor, whose size is the motion and whose angle the phase. In a band around each
    line, the factors maximise the likelihood of the channel given the wavefront: what the
    wavefront's noise leaves open of the line, by the spectra of the model, is a second noise that
    grows with the factor, so noise of the wavefront does not bias it (errors in variables).
    Standard errors count those of the model's sensor gains, which turn all factors together.

    Parameters
    ----------
    model : IdentifiedModel
        The model that :func:`identify` found in the record.
    record : LoopRecord
        Record of the loop.
    accelerations : (frames, channels) or (frames,) array_like
        Readings [m/s^2], one per frame of the loop; the first belongs to the first frame of the
        record, but for a shift. NaN where one is missing.
    channels : sequence of str, optional
        Names of the channels; channel1, channel2, ... by default.
    false_alarm : float, optional
        Probability that any line shows in any of these channels without being there.
    largest_shift_s : float, optional
        Largest shift between the clocks that is looked for [s].

    Returns
    -------
    AccelerometerTransfers
        Motions and phases with standard errors, noise, the shift of the clocks, and verdicts.

    Raises
    ------
    ProblemError
        If sizes clash, a value is out of range, or record and readings overlap too little.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> from scipy.signal import lfilter
    >>> line = lbt.Vibration(frequency_hz=31, damping=0.01, rms_nm=60).ar_model(1000)
    >>> rng = np.random.default_rng(1)
    >>> drive = line.driving_rms_nm * rng.standard_normal(20_002)
    >>> v = lfilter([1], [1, *-line.coefficients], drive)
    >>> z = v[1:-1] + 5 * rng.standard_normal(20_000)
    >>> a = -2 * 1e-9 * (2 * np.pi * 31) ** 2 * v[1:-1] + 1e-3 * rng.standard_normal(20_000)
    >>> record = lbt.identification.loop_record(z, frame_rate_hz=1000, unit="nm")
    >>> found = lbt.identification.accelerometer_transfers(lbt.identify(record), record, a)
    >>> round(found.transfers[0].motion_nm_per_nm, 1), found.channels[0].verdict
    (2.0, 'used for 31 Hz')
    """
    given = as_columns(accelerations)
    readings, good = fill_missing(given)
    names = _names(channels, readings.shape[1])
    if len(model.axes) != record.axes:
        raise DimensionError(
            f"model and record must have the same axes; got {len(model.axes)} and {record.axes}."
        )
    alarm = number(false_alarm, "false_alarm", above=0, below=1)
    largest = int(number(largest_shift_s, "largest_shift_s", at_least=0) * model.frame_rate_hz)
    live = [c for c, series in enumerate(readings.T) if _is_live(series[good])]
    places = [i for i, part in enumerate(model.parts) if part.kind == "line"]
    if not live or not places:
        return AccelerometerTransfers(
            transfers=(),
            channels=_channel_rows(names, (), {}, live),
            shift_frames=0.0,
            shift_error_frames=float("inf"),
            shift_by_phases=False,
            age_frames=1,
            rate_hz=model.frame_rate_hz,
        )
    lines = [model.parts[i] for i in places]
    widest = max(line.damping * line.frequency_hz for line in lines)
    tried = len(live) * len(lines) * (1 + np.ceil(4 * widest * largest / model.frame_rate_hz))
    limit = alarm / tried
    lag, fits, (shift, error, by_phases) = lay_and_fit(
        model, record, readings[:, live], good, lines, largest, limit
    )
    rows = [_row(fit, names[live[fit[3]]], places, model, limit) for fit in fits]
    rows.sort(key=lambda row: (names.index(row.channel), row.frequency_hz))
    noises = {live[c]: _noise(fits, c, model.frame_rate_hz, limit) for c in range(len(live))}
    shown = [row for row in rows if row.useful]
    best = _best_channels(shown, {names[c]: noise for c, noise in noises.items()}, model)
    return AccelerometerTransfers(
        transfers=tuple(replace(row, useful=row.useful and row.channel in best) for row in rows),
        channels=_channel_rows(names, rows, noises, live, best),
        shift_frames=shift + lag,
        shift_error_frames=error,
        shift_by_phases=by_phases,
        age_frames=lag + 1,
        rate_hz=model.frame_rate_hz,
    )


def _is_live(readings: FloatArray) -> bool:
    """Return whether the readings (frames,) of a channel are more than rounding."""
    values = np.unique(readings)
    rounding = _ROUNDING * max(float(np.max(np.abs(values), initial=0.0)), _LEAST_M_S2)
    return bool(values.size > _FEWEST_VALUES and np.ptp(values) > rounding)


def _channel_rows(
    names: Sequence[str],
    rows: Sequence[TransferRow],
    noises: Mapping[int, float],
    live: Sequence[int],
    best: Sequence[str] = (),
) -> tuple[ChannelRow, ...]:
    return tuple(
        ChannelRow(
            channel=name,
            noise_m_s2=noises.get(c, float("nan")),
            verdict=_verdict(name, rows, name in best) if c in live else "dead",
        )
        for c, name in enumerate(names)
    )


def _names(channels: Sequence[str] | None, count: int) -> tuple[str, ...]:
    names = tuple(channels or (f"channel{c + 1}" for c in range(count)))
    if len(names) != count or len(set(names)) < count:
        raise ProblemError(
            f"channels must be {count} different names, one per column; got {', '.join(names)}."
        )
    return names


def _row(
    pair: Pair, name: str, places: Sequence[int], model: IdentifiedModel, limit: float
) -> TransferRow:
    band, fit, j, _ = pair
    place, factor = places[band.lines[j]], fit.factors[j]
    error, across = fit.errors(j)
    return TransferRow(
        channel=name,
        line=place,
        frequency_hz=model.parts[place].frequency_hz,
        motion_nm_per_nm=float(abs(factor)),
        motion_error_nm_per_nm=error,
        phase_deg=float(np.degrees(np.angle(factor))),
        phase_error_deg=float(min(np.degrees(across / max(abs(factor), _TINY)), 180.0)),
        coherence=float(fit.coherences[j]),
        chance=chance(pair),
        useful=chance(pair) < limit,
    )


def _noise(pairs: Sequence[Pair], channel: int, rate: float, limit: float) -> float:
    """Return the noise of a reading near the lines that a channel shows, or near all [m/s^2]."""
    own = [pair for pair in pairs if pair[3] == channel]
    shown = [pair for pair in own if chance(pair) < limit] or own
    return float(np.sqrt(np.mean([pair[1].noise[pair[2]] for pair in shown]) * rate / 2))


def _best_channels(
    rows: Sequence[TransferRow], noises: Mapping[str, float], model: IdentifiedModel
) -> list[str]:
    """Return the channels that tell most of the lines' power, as many as a design takes."""
    known: dict[str, dict[int, float]] = {row.channel: {} for row in rows}
    for row in rows:
        line = model.parts[row.line]
        size = NM * (2 * np.pi * line.frequency_hz) ** 2 * line.rms_nm * row.motion_nm_per_nm
        known[row.channel][row.line] = float((size / max(noises[row.channel], _TINY)) ** 2)
    best: list[str] = []

    def worth(channel: str) -> float:
        chosen = [*best, channel]
        return sum(
            model.parts[line].rms_nm ** 2
            * math.log1p(sum(known[each].get(line, 0.0) for each in chosen))
            for line in {row.line for row in rows}
        )

    while len(best) < min(len(known), MOST_UNITS - 1):
        best.append(max((each for each in known if each not in best), key=worth))
    return best


def _verdict(name: str, rows: Sequence[TransferRow], best: bool) -> str:
    """Return what a channel is used for, in words."""
    lines = [f"{row.frequency_hz:.3g}" for row in rows if row.channel == name and row.useful]
    use = f"{'used for' if best else 'shows'} {', '.join(lines)} Hz" if lines else "adds nothing"
    return f"{_EXTRA}; {use}" if lines and not best else use


def lay_and_fit(
    model: IdentifiedModel,
    record: LoopRecord,
    readings: FloatArray,
    good: BoolArray,
    lines: Sequence[IdentifiedLine],
    largest: int,
    limit: float,
) -> tuple[int, list[Pair], Shift]:
    """Lay readings beside the wavefront, and fit them there.

    Return by how many frames they are late, the fits, and the shift beyond the whole frames.
    """
    gains, lag = np.array(model.sensor_gains), 0
    errors = np.array([axis.sensor_gain_error or 0.0 for axis in model.axes])
    series = record.pseudo_open_loop(gains)
    moved = record.pseudo_open_loop(gains + errors) - series
    near = round(_NEAR_S * model.frame_rate_hz)

    def bands(stretches: Stretches) -> list[LineBand]:
        laid = readings[np.clip(np.arange(record.frames) + lag, 0, len(readings) - 1)]
        return line_bands(model, lines, series, moved, laid, stretches)

    def side_by_side() -> Stretches:
        frames = np.arange(record.frames) + lag
        known = (frames >= 0) & (frames < len(readings))
        usable = record.usable & known & good[np.where(known, frames, 0)]
        found = tuple((int(a), int(b)) for a, b in runs(usable) if b - a >= SHORTEST_SEGMENT)
        if not found:
            raise ProblemError(
                f"record and accelerations must have {SHORTEST_SEGMENT} usable frames in a row "
                f"side by side; they have {record.frames} and {len(readings)} frames."
            )
        return found

    lag = likeliest_lag(bands(side_by_side()), largest)
    for step in range(_PASSES):
        fits = fit_pairs(bands(side_by_side()))
        shift, error, by_phases = clock_shift([fit for fit in fits if chance(fit) < limit], near)
        sure = by_phases or abs(shift) > 3 * error
        if step == _PASSES - 1 or not sure or not round(shift):
            break
        lag += round(shift)
    return lag, fits, (shift, error, by_phases)


def fit_pairs(bands: Sequence[LineBand]) -> list[Pair]:
    """Return the fit of every channel with every line."""
    out: list[Pair] = []
    for channel in range(bands[0].readings.shape[1]):
        factors = np.zeros(bands[0].expected.shape[1], dtype=complex)
        for _ in range(_ROUNDS):
            fits = [fit_band(band, channel, factors) for band in bands]
            for band, fit in zip(bands, fits, strict=True):
                factors[list(band.lines)] = fit.factors
        out += [
            (band, fit, j, channel)
            for band, fit in zip(bands, fits, strict=True)
            for j in range(len(band.lines))
        ]
    return out


def chance(pair: Pair) -> float:
    """Return the probability that a channel without the line shows as much."""
    return float(pair[1].chances[pair[2]])


def likeliest_lag(bands: Sequence[LineBand], largest: int) -> int:
    """Return the whole number of frames at which readings and wavefront agree best."""
    lags = np.arange(-largest, largest + 1.0)
    total = np.zeros(lags.size)
    for band in bands:
        middle = float(np.mean(band.angle[[0, -1]]))
        away = band.angle - middle  # a product changes over lags as slowly as the band is narrow
        step = max(int(_TURN / float(np.max(np.abs(away), initial=_TURN / lags.size))), 1)
        tried = np.append(np.arange(-largest, largest, step), largest).astype(float)
        turns = np.exp(1j * tried[:, None] * away)
        for line in band.lines:
            products = band.expected[:, line, None].conj() * band.readings
            power = np.sum(np.abs(products) ** 2, axis=0)
            seen = power > 0
            sizes = np.sum(np.abs(turns @ products[:, seen]) ** 2 / power[seen], axis=1)
            total += np.interp(lags, tried, sizes)
    best = int(np.argmax(total))
    return int(lags[best]) if total[best] > total[largest] + _CLEARLY else 0


def clock_shift(pairs: Sequence[Pair], largest: float) -> Shift:
    """Return the shift of the readings of the pairs of channel and line, within +- ``largest``."""
    from scipy.special import chdtrc

    if not pairs:
        return 0.0, float("inf"), False
    lags = np.arange(-largest, largest + _STEP / 2, _STEP)
    free, real = _evidence(pairs, lags)
    place, error = _peak(pairs, float(lags[np.argmax(real)]), 1)
    both = _evidence(pairs, np.array([place]))
    peaks = np.flatnonzero((real[1:-1] > real[:-2]) & (real[1:-1] > real[2:])) + 1
    rivals = (np.abs(lags[peaks] - place) > 2 * _STEP) & (real[peaks] > both[1][0] - _RIVAL)
    misfit, others = 2 * float(both[0][0] - both[1][0]), len(pairs) - 1
    if others and not rivals.any() and chdtrc(others, misfit) > _CHANCE:
        spread = np.sqrt(max(misfit / others, 1.0))
        error = float(np.hypot(error * spread, _gain_error(pairs)))
        return place, error, True
    place, error = _peak(pairs, float(lags[np.argmax(free)]), 0)
    return place, error, False


def _gain_error(pairs: Sequence[Pair]) -> float:
    """Return what errors of the sensor gains leave of the shift by phases [frames].

    They turn the factors of all lines and channels at once.
    """
    slope, size = 0.0, 0.0
    for band, fit, j, _ in pairs:
        turn = (fit.slopes[j] / fit.factors[j]).imag  # [rad] per standard error of each gain
        angle = float(np.mean(band.angle[band.core[:, j]]))
        weight = 2 * abs(fit.factors[j]) ** 2 / fit.variances[j]
        slope, size = slope + weight * angle * turn, size + weight * angle**2
    return float(np.linalg.norm(slope / size))


def _evidence(pairs: Sequence[Pair], lags: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return log-likelihoods over lags, for factors of any phase and for real ones."""
    free, real = np.zeros(lags.size), np.zeros(lags.size)
    for band, fit, j, _ in pairs:
        sums, size = _matched(band, fit, j, lags)
        free += np.abs(sums) ** 2 / size
        real += sums.real**2 / size
    return free, real


def _matched(band: LineBand, fit: BandFit, j: int, lags: FloatArray) -> tuple[ComplexArray, float]:
    """Return products of readings and expectation over lags, and the size of the latter.

    The other lines of the band are taken away.
    """
    core, x = band.core[:, j], band.expected[:, list(band.lines)]
    alone = fit.readings - x @ fit.factors + x[:, j] * fit.factors[j]
    seen = (x[:, j].conj() * fit.weights)[core]
    turns = np.exp(1j * lags[:, None] * band.angle[core])
    scale = abs(fit.factors[j]) ** 2 / max(fit.variances[j], np.finfo(float).tiny)
    size = float((np.abs(x[core, j]) ** 2 * fit.weights[core]).sum())
    # in units in which the log-likelihood of the fit itself is that of its errors
    size *= max(abs(fit.factors[j]) ** 2 * size / scale, 1.0)
    return turns @ (seen * alone[core]), size


def _peak(pairs: Sequence[Pair], near: float, which: int) -> tuple[float, float]:
    """Return the place of a maximum near a lag and its standard error [frames]."""
    for step in (_STEP / 5, _FINE):
        lags = np.arange(-10.0, 11.0) * step + near
        near = float(lags[np.argmax(_evidence(pairs, lags)[which])])
    width = 0.05
    for _ in range(12):  # a step over which the likelihood changes by about 1
        low, top, high = _evidence(pairs, np.array([near - width, near, near + width]))[which]
        curvature = (2 * top - low - high) / width**2
        if 2 * top - low - high > 1 or curvature <= 0:
            break
        width *= 2
    if curvature <= 0:
        return near, float("inf")
    place = near + width * (high - low) / (2 * (2 * top - low - high))
    return place, float(1 / np.sqrt(curvature))
