"""How each channel of accelerometers moves with each line of an identified model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.accelerometers.band_fit import fit_band
from lbt_synth.identification.accelerometers.channel_faults import channel_fault
from lbt_synth.identification.accelerometers.clock_shift import (
    ClockShift,
    Pair,
    clock_shift,
    likeliest_lag,
)
from lbt_synth.identification.accelerometers.line_bands import LineBand, line_bands
from lbt_synth.identification.accelerometers.readings import fill_missing
from lbt_synth.identification.accelerometers.swapped import Factor, swapped_channels
from lbt_synth.identification.fit.identified_model import IdentifiedLine, IdentifiedModel
from lbt_synth.identification.records.faults import runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.storage.rows import column, row_table, table_row
from lbt_synth.storage.tables import Table
from lbt_synth.validation import BoolArray, FloatArray, number

_SHORTEST = 256  # frames side by side
_ERRORS = 5.0  # between the shifts of two channels that differ
_LEAST_SHIFT = 0.2  # frames, that are worth a word
_PASSES = 3
_ROUNDS = 3  # in which the skirts of strong lines leave the bands of others
LEFT_OUT = ("dead", "saturated")


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
    """What accelerometers show of the lines of a model.

    Attributes
    ----------
    transfers : tuple of TransferRow
        Each channel with each line, in the convention of the model's configuration.
    channels : tuple of ChannelRow
        Each channel with its noise and a verdict.
    shift : ClockShift
        By how many frames the readings lag behind the wavefront, as they were given.
    age_frames : int
        Age of a reading for which the phases hold [frames]: 1 is that of the wavefront's
        measurement of the same frame.
    rate_hz : float
        Readings per second, after averaging [Hz].
    """

    transfers: tuple[TransferRow, ...]
    channels: tuple[ChannelRow, ...]
    shift: ClockShift
    age_frames: int
    rate_hz: float

    @property
    def used(self) -> tuple[ChannelRow, ...]:
        """The channels that show a line."""
        names = {row.channel for row in self.transfers if row.useful}
        return tuple(row for row in self.channels if row.channel in names)

    @property
    def shift_text(self) -> str:
        """The shift of the clocks in words."""
        if not self.used:
            return "no channel shows a line, so the clocks were not compared."
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
    largest_shift_s: float = 1.0,
    earlier: Sequence[tuple[float, Mapping[str, complex]]] = (),
) -> AccelerometerTransfers:
    r"""Find how the channels of accelerometers move with the lines of an identified model.

    A channel c reads, in frame k of the loop,

    ``a_c(k) = 1e-9 sum_j F_cj (v_j(k-g+1) - 2 v_j(k-g) + v_j(k-g-1)) f_s^2 + noise``

    with v_j the line j [nm of wavefront], g the age of the reading, and F_cj a complex factor at
    the line's frequency, whose size is the motion and whose angle the phase. In a band around each
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
    earlier : sequence of (float, mapping of str to complex), optional
        Lines of an earlier model: frequency [Hz] and the factors of channels by name. Without
        them, exchanged channels cannot be found.

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
    >>> a = 2 * 1e-9 * 1000**2 * np.diff(v, 2) + 1e-3 * rng.standard_normal(20_000)
    >>> record = lbt.identification.loop_record(z, frame_rate_hz=1000, unit="nm")
    >>> found = lbt.identification.accelerometer_transfers(lbt.identify(record), record, a)
    >>> round(found.transfers[0].motion_nm_per_nm, 1), found.channels[0].verdict
    (2.0, 'used for 31 Hz')
    """
    readings, good = fill_missing(accelerations)
    names = _names(channels, readings.shape[1])
    if len(model.axes) != record.axes:
        raise DimensionError(
            f"model and record must have the same axes; got {len(model.axes)} and {record.axes}."
        )
    alarm = number(false_alarm, "false_alarm", above=0, below=1)
    largest = int(number(largest_shift_s, "largest_shift_s", at_least=0) * model.frame_rate_hz)
    faults = [channel_fault(each[good], model.frame_rate_hz) for each in readings.T]
    live = [c for c, fault in enumerate(faults) if fault not in LEFT_OUT]
    places = [i for i, part in enumerate(model.parts) if part.kind == "line"]
    if not live or not places:
        return AccelerometerTransfers(
            transfers=(),
            channels=tuple(
                ChannelRow(channel=name, noise_m_s2=float("nan"), verdict=_verdict(name, (), fault))
                for name, fault in zip(names, faults, strict=True)
            ),
            shift=clock_shift((), largest),
            age_frames=1,
            rate_hz=model.frame_rate_hz,
        )
    lines = [model.parts[i] for i in places]
    widest = max(line.damping * line.frequency_hz for line in lines)
    tried = len(live) * len(lines) * (1 + np.ceil(4 * widest * largest / model.frame_rate_hz))
    limit = alarm / tried
    lag, fits = _lay_and_fit(model, record, readings[:, live], good, lines, largest, limit)
    shift, odd = _shifts([fit for fit in fits if _chance(fit) < limit], largest)
    rows = [_row(fit, names[live[fit[3]]], places, model, limit) for fit in fits]
    rows.sort(key=lambda row: (names.index(row.channel), row.frequency_hz))
    noises = {live[c]: _noise(fits, c, model.frame_rate_hz, limit) for c in range(len(live))}
    swapped = swapped_channels(_factors(rows), earlier) if earlier else {}
    wrong = {live[c]: f"shifted by {frames:.3g} frames against others" for c, frames in odd.items()}
    return AccelerometerTransfers(
        transfers=tuple(rows),
        channels=tuple(
            ChannelRow(
                channel=name,
                noise_m_s2=noises.get(c, float("nan")),
                verdict=_verdict(
                    name, rows, faults[c], wrong.get(c, ""), _swap_text(swapped.get(name))
                ),
            )
            for c, name in enumerate(names)
        ),
        shift=replace(shift, frames=shift.frames + lag),
        age_frames=lag + 1,
        rate_hz=model.frame_rate_hz,
    )


def _names(channels: Sequence[str] | None, count: int) -> tuple[str, ...]:
    names = tuple(channels or (f"channel{c + 1}" for c in range(count)))
    if len(names) != count or len(set(names)) < count:
        raise ProblemError(
            f"channels must be {count} different names, one per column; got {', '.join(names)}."
        )
    return names


def _lay_and_fit(
    model: IdentifiedModel,
    record: LoopRecord,
    readings: FloatArray,
    good: BoolArray,
    lines: Sequence[IdentifiedLine],
    largest: int,
    limit: float,
) -> tuple[int, list[Pair]]:
    """Return the whole frames by which readings come late, and fits of them without that."""
    gains, lag = np.array(model.sensor_gains), 0
    errors = np.array([axis.sensor_gain_error or 0.0 for axis in model.axes])
    series = record.pseudo_open_loop(gains)
    moved = record.pseudo_open_loop(gains + errors) - series
    for step in range(_PASSES):
        frames = np.arange(record.frames) + lag
        known = (frames >= 0) & (frames < len(readings))
        index = np.where(known, frames, 0)
        usable = record.usable & known & good[index]
        stretches = [(int(a), int(b)) for a, b in runs(usable) if b - a >= _SHORTEST]
        if not stretches:
            raise ProblemError(
                f"record and accelerations must have {_SHORTEST} usable frames in a row side by "
                f"side; they have {record.frames} and {len(readings)} frames."
            )
        bands = line_bands(model, lines, series, moved, readings[index], stretches)
        if step == 0 and (extra := likeliest_lag(bands, largest)):
            lag += extra
            continue
        fits = fit_pairs(bands)
        shift, _ = _shifts([fit for fit in fits if _chance(fit) < limit], largest)
        sure = shift.by_phases or abs(shift.frames) > 3 * shift.error_frames
        if step == _PASSES - 1 or not sure or not round(shift.frames):
            break
        lag += round(shift.frames)
    return lag, fits


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


def _chance(pair: Pair) -> float:
    return float(pair[1].chances[pair[2]])


def _shifts(pairs: Sequence[Pair], largest: int) -> tuple[ClockShift, dict[int, float]]:
    """Return the shift of the channels, and of those that have another, against the first."""
    own = {
        channel: clock_shift([pair for pair in pairs if pair[3] == channel], largest)
        for channel in sorted({pair[3] for pair in pairs})
    }
    known = {channel: shift for channel, shift in own.items() if shift.by_phases}
    if not known:
        return clock_shift(pairs, largest), {}
    middle = sorted(known.values(), key=lambda shift: shift.frames)
    common = min(middle[(len(middle) - 1) // 2 : len(middle) // 2 + 1], key=lambda s: abs(s.frames))
    odd = {
        channel: shift.frames - common.frames
        for channel, shift in known.items()
        if abs(shift.frames - common.frames)
        > max(_ERRORS * np.hypot(shift.error_frames, common.error_frames), _LEAST_SHIFT)
    }
    return clock_shift([pair for pair in pairs if pair[3] not in odd], largest), odd


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
        phase_error_deg=float(min(np.degrees(across / max(abs(factor), 1e-300)), 180.0)),
        coherence=float(fit.coherences[j]),
        chance=_chance(pair),
        useful=_chance(pair) < limit,
    )


def _noise(pairs: Sequence[Pair], channel: int, rate: float, limit: float) -> float:
    """Return the noise of a reading near the lines that a channel shows, or near all [m/s^2]."""
    own = [pair for pair in pairs if pair[3] == channel]
    shown = [pair for pair in own if _chance(pair) < limit] or own
    return float(np.sqrt(np.mean([pair[1].noise[pair[2]] for pair in shown]) * rate / 2))


def _factors(rows: Sequence[TransferRow]) -> dict[str, list[Factor]]:
    """Return frequency, complex factor and standard error of each line, by channel."""
    out: dict[str, list[Factor]] = {}
    for row in rows:
        factor = complex(row.motion_nm_per_nm * np.exp(1j * np.radians(row.phase_deg)))
        own = (row.frequency_hz, factor, row.motion_error_nm_per_nm)
        out.setdefault(row.channel, []).append(own)
    return out


def _swap_text(other: str | None) -> str:
    return f"swapped with {other}" if other else ""


def _verdict(name: str, rows: Sequence[TransferRow], *wrong: str) -> str:
    """Return what a channel is used for, and what is wrong with it, in words."""
    lines = [f"{row.frequency_hz:.3g}" for row in rows if row.channel == name and row.useful]
    use = f"used for {', '.join(lines)} Hz" if lines else "adds nothing"
    return "; ".join([*(text for text in wrong if text), use])
