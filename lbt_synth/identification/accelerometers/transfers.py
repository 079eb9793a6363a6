"""How each channel of accelerometers moves with each line of an identified model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.fallbacks import MOST_UNITS
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.accelerometers.laying import (
    ClockShift,
    Pair,
    chance,
    clock_shift,
    lay_and_fit,
)
from lbt_synth.identification.accelerometers.line_bands import NM
from lbt_synth.identification.accelerometers.readings import as_columns, fill_missing
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.records.faults import find_saturated
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models.sensor_suite import LONGEST_DELAY
from lbt_synth.storage.rows import column, row_table, table_row
from lbt_synth.storage.tables import Table
from lbt_synth.validation import FloatArray, number

_TINY = 1e-300
_EXTRA = f"left out, because others show more and a design takes {MOST_UNITS - 1} channels"
_LEFT_OUT = ("dead", "saturated")
_FEWEST_VALUES = 4  # a series of no more different numbers is rounding
_ROUNDING = 1e-12  # of the largest number
_LEAST_M_S2 = 1e-6  # far below what any accelerometer resolves
_CLIPPED = 10  # frames at the ends, at least
_DRIFT = 100.0  # power at low frequencies over the median
_SLOW_HZ = 1.0


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
    shift: ClockShift  # lag of the readings behind the wavefront, as they were given
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
        size = f"{self.shift.frames:.3g} +- {self.shift.error_frames:.2g} frames"
        if self.shift.by_phases:
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
    faults = [
        _channel_fault(raw, model.frame_rate_hz) if filled.any() else "dead"
        for raw, filled in zip(given.T, readings.T, strict=True)
    ]
    live = [c for c, fault in enumerate(faults) if fault not in _LEFT_OUT]
    places = [i for i, part in enumerate(model.parts) if part.kind == "line"]
    if not live or not places:
        return AccelerometerTransfers(
            transfers=(),
            channels=_channel_rows(names, (), {}, faults),
            shift=clock_shift((), largest),
            age_frames=1,
            rate_hz=model.frame_rate_hz,
        )
    lines = [model.parts[i] for i in places]
    widest = max(line.damping * line.frequency_hz for line in lines)
    tried = len(live) * len(lines) * (1 + np.ceil(4 * widest * largest / model.frame_rate_hz))
    limit = alarm / tried
    lag, fits, shift = lay_and_fit(model, record, readings[:, live], good, lines, largest, limit)
    rows = [_row(fit, names[live[fit[3]]], places, model, limit) for fit in fits]
    rows.sort(key=lambda row: (names.index(row.channel), row.frequency_hz))
    noises = {live[c]: _noise(fits, c, model.frame_rate_hz, limit) for c in range(len(live))}
    shown = [row for row in rows if row.useful]
    best = _best_channels(shown, {names[c]: noise for c, noise in noises.items()}, model)
    return AccelerometerTransfers(
        transfers=tuple(replace(row, useful=row.useful and row.channel in best) for row in rows),
        channels=_channel_rows(names, rows, noises, faults, best),
        shift=replace(shift, frames=shift.frames + lag),
        age_frames=lag + 1,
        rate_hz=model.frame_rate_hz,
    )


def _channel_fault(readings: FloatArray, rate_hz: float) -> str:
    """Return dead, saturated, drifting, or an empty text, for the readings (frames,) of one."""
    readings = readings[np.isfinite(readings)]
    values = np.unique(readings)
    rounding = _ROUNDING * max(float(np.max(np.abs(values), initial=0.0)), _LEAST_M_S2)
    if values.size <= _FEWEST_VALUES or np.ptp(values) <= rounding:
        return "dead"
    if np.sum(find_saturated(readings, np.ones(readings.size, dtype=np.bool_))) >= _CLIPPED:
        return "saturated"
    return "drifting" if _drifts(readings, rate_hz) else ""


def _drifts(readings: FloatArray, rate_hz: float) -> bool:
    from scipy.signal import periodogram

    frequency, power = periodogram(readings, rate_hz, window="cosine")
    slow = (frequency > 0) & (frequency < _SLOW_HZ)
    if not slow.any():
        return False
    return bool(np.mean(power[slow]) > _DRIFT * np.median(power[1:]))


def _channel_rows(
    names: Sequence[str],
    rows: Sequence[TransferRow],
    noises: Mapping[int, float],
    faults: Sequence[str],
    best: Sequence[str] = (),
) -> tuple[ChannelRow, ...]:
    return tuple(
        ChannelRow(
            channel=name,
            noise_m_s2=noises.get(c, float("nan")),
            verdict=_verdict(name, rows, fault, name in best),
        )
        for c, (name, fault) in enumerate(zip(names, faults, strict=True))
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


def _verdict(name: str, rows: Sequence[TransferRow], fault: str, best: bool) -> str:
    """Return what a channel is used for, and what is wrong with it, in words."""
    lines = [f"{row.frequency_hz:.3g}" for row in rows if row.channel == name and row.useful]
    use = f"{'used for' if best else 'shows'} {', '.join(lines)} Hz" if lines else "adds nothing"
    extra = _EXTRA if lines and not best else ""
    return "; ".join(text for text in (extra, fault, use) if text)
