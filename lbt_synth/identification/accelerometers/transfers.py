"""How each channel of accelerometers moves with each line of an identified model.

One regression: around each line, a Wiener filter with the spectra of the model estimates the line's
motion from the wavefront. Given the wavefront, the readings of a channel are normal with the mean
``expected F`` and the variance ``noise + open``: what the wavefront leaves open of the lines moves
the channel, too. The factors F of all lines are found together with these weights, in turn with the
noise, whose median is robust against lines of the channel's own. Readings are moved by whole frames
if the slope of the phase within the lines surely says so; the rest of a shift is in the phases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import detrend
from scipy.special import gammaincc

from lbt_synth.design.filter_design import MOST_UNITS
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.accelerometers.readings import Channels, read_channels
from lbt_synth.identification.fit.identified_model import DIFFERENT, IdentifiedLine, IdentifiedModel
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT, TAPER, tukey
from lbt_synth.identification.records.faults import runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models.sensor_suite import LONGEST_DELAY
from lbt_synth.storage.rows import column, table_row
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

_TINY = np.finfo(np.float64).tiny
_NOTHING = "adds nothing"
_EXTRA = f"left out, because a design takes {MOST_UNITS - 1} channels"
_INDEPENDENT = (1 - 5 * TAPER / 8) ** 2 / (1 - 93 * TAPER / 128)  # of tapered values
_REACH = 20.0  # half widths of a line, or bins, from its centre to the edge of its band
_ROUNDS = 20  # of factors and noise, of which each brings them nearer by a factor of two or more
_DOUBT = 0.01  # chance below which a channel moves at a line more than its noise explains


@table_row
class TransferRow:
    """How one channel moves with one line, with standard errors."""

    channel: str = column("channel")
    line: int = column()  # its index among the resonances of the model
    frequency_hz: float = column("f", unit="Hz", format=".3f")
    # of the channel per motion of the wavefront, and its phase against that
    motion_nm_per_nm: float = column("motion", unit="nm/nm", format=".4g")
    motion_error_nm_per_nm: float = column("+-", unit="nm/nm", format=".2g")
    phase_deg: float = column("phase", unit="deg", format=".1f")
    phase_error_deg: float = column("+-", unit="deg", format=".2g")
    # share of the power at the line that goes with the wavefront
    coherence: float = column("coherence", format=".3f")
    chance: float = column("chance", format=".1g")  # that a channel without it shows as much
    useful: bool = column("used")  # whether the line shows in the channel beyond chance


@table_row
class ChannelRow:
    """One channel of the accelerometers: its noise near the lines, and whether it is used."""

    channel: str = column("channel")
    noise_m_s2: float = column("noise", unit="m/s^2", format=".3g")
    verdict: str = column("verdict")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AccelerometerTransfers:
    """What accelerometers show of the lines of a model."""

    # each channel with each line, in the convention of the model's configuration
    transfers: tuple[TransferRow, ...]
    channels: tuple[ChannelRow, ...]  # each channel with its noise and a verdict
    # by how many frames the readings, as they were given, lag behind the wavefront's measurement of
    # the same frame, by the slope of the phase within lines; above 0 if they come late
    shift_frames: float
    shift_error_frames: float  # standard error; infinite without any line
    # age of a reading for which the phases hold; 1 is the wavefront's of the same frame
    age_frames: int

    @property
    def used(self) -> tuple[ChannelRow, ...]:
        """The channels that show a line."""
        names = {row.channel for row in self.transfers if row.useful}
        return tuple(row for row in self.channels if row.channel in names)

    def loop_age(self, delay_frames: float) -> int:
        """Return the age of a reading in a loop of some delay: 1 where the clocks hide it."""
        delay = self.age_frames + delay_frames - 1
        return self.age_frames if self.age_frames >= 0 and 1 <= delay <= LONGEST_DELAY else 1

    @property
    def shift_text(self) -> str:
        """The shift of the clocks in words."""
        if not self.used:
            return (
                "no channel shows a line, so the clocks were not compared. If lines should show, "
                "check the rate of the readings, and when they began (accelerometer_rate_hz)."
            )
        return (
            f"the accelerometers lag behind the wavefront by {self.shift_frames:.3g} +- "
            f"{self.shift_error_frames:.2g} frames, by the slope of the phase within lines. Phases "
            f"hold for a shift of {self.age_frames - 1}."
        )


def accelerometer_transfers(
    model: IdentifiedModel,
    record: LoopRecord,
    accelerations: ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    largest_shift_s: float = 10.0,
) -> AccelerometerTransfers:
    """Find how the channels of accelerometers move with the lines of an identified model.

    A channel c reads ``a_c(k) = 1e-9 sum_j F_cj a_j(k-g) + noise`` in frame k of the loop, with
    a_j(k) the mean acceleration of the line j [nm/s^2 of wavefront] over frame k, g the age of the
    reading, and F_cj a complex factor, whose size is the motion and whose angle the phase. Standard
    errors count those of the model's sensor gains. The readings are (frames, channels) or (frames,)
    [m/s^2], the first that of the first frame of the record, but for a shift between the clocks of
    at most ``largest_shift_s``; NaN where one is missing. The probability that any line shows in
    any of these channels without being there is 0.001.
    """
    read = read_channels(accelerations, channels)
    if len(model.axes) != record.axes:
        raise DimensionError(
            f"model and record must have the same axes; got {len(model.axes)} and {record.axes}."
        )
    resonant = [
        resonance.kind != "turbulence" and resonance.sections == 1 for resonance in model.parts
    ]
    places = np.flatnonzero(resonant).tolist()
    places.sort(key=lambda i: model.parts[i].frequency_hz)
    lines = [model.parts[i] for i in places]
    lag, shift, error, transfers = 0, 0.0, float("inf"), tuple[TransferRow, ...]()
    rows = [(name, np.nan, _NOTHING) for name in read.names]
    if read.names and lines:
        widest_hz = max(line.damping * line.frequency_hz for line in lines)
        shifts = 1 + np.ceil(4 * widest_hz * largest_shift_s)  # that differ
        limit = 1e-3 / (len(read.names) * len(lines) * shifts)
        largest = int(largest_shift_s * model.frame_rate_hz)
        lag, fits, shift, error = _lay_and_fit(model, record, lines, read, largest, limit)
        shown = fits.chances < limit
        # the channels that show most of the lines' power, as many as a design takes
        power = (fits.coherences * shown) @ np.array([line.rms_nm**2 for line in lines])
        used = shown & (power >= np.sort(power)[-(MOST_UNITS - 1) :][0])[:, None]
        counted = shown | ~shown.any(axis=1, keepdims=True)  # the lines it shows, or all
        level = np.sum(fits.noise * counted, axis=1) / np.sum(counted, axis=1)
        noise = np.sqrt(level * model.frame_rate_hz / 2).tolist()
        verdicts = np.select([used.any(1), shown.any(1)], ["used", _EXTRA], _NOTHING).tolist()
        rows = list(zip(read.names, noise, verdicts, strict=True))
        transfers = _transfer_rows(read.names, places, lines, fits, used)
    rows += [(name, np.nan, "dead") for name in read.dead]
    return AccelerometerTransfers(
        transfers=transfers,
        channels=tuple(
            ChannelRow(channel=name, noise_m_s2=noise, verdict=verdict)
            for name, noise, verdict in rows
        ),
        shift_frames=shift,
        shift_error_frames=error,
        age_frames=lag + 1,
    )


def _transfer_rows(
    channels: Sequence[str],
    places: Sequence[int],
    lines: Sequence[IdentifiedLine],
    fits: _Fits,
    used: BoolArray,
) -> tuple[TransferRow, ...]:
    """Return what the fits of channels say of lines."""
    motions = np.abs(fits.factors)
    turned = np.minimum(np.degrees(fits.across / np.maximum(motions, _TINY)), 180.0)
    return tuple(
        TransferRow(
            channel=name,
            line=places[j],
            frequency_hz=line.frequency_hz,
            motion_nm_per_nm=float(motions[c, j]),
            motion_error_nm_per_nm=float(fits.along[c, j]),
            phase_deg=float(np.angle(fits.factors[c, j], deg=True)),
            phase_error_deg=float(turned[c, j]),
            coherence=float(fits.coherences[c, j]),
            chance=float(fits.chances[c, j]),
            useful=bool(used[c, j]),
        )
        for c, name in enumerate(channels)
        for j, line in enumerate(lines)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Bands:
    """Frequencies of a stretch of a record around all lines; densities per Hz."""

    frames: int  # of the stretch
    bins: IntArray  # (f,): of its transform
    angle: FloatArray  # (f,) [rad per frame]
    readings: ComplexArray  # (f, channels) [m/s^2]
    expected: ComplexArray  # (f, lines): of a motion of 1 nm per nm [m/s^2]
    moved: ComplexArray  # (f, lines, axes): change of it for a standard error of each gain
    seen: FloatArray  # (f, axes, lines): root of the power that the wavefront shows [m/s^2]
    shapes: FloatArray  # (f, lines): power of the lines [(m/s^2)^2]

    def open_power(self, factors: ComplexArray) -> FloatArray:
        """Return the power of a channel's motion that the wavefront leaves open, (f,)."""
        seen = np.sum(np.abs(self.seen @ factors) ** 2, axis=1)
        return np.asarray(np.maximum(self.shapes @ np.abs(factors) ** 2 - seen, 0.0))


def _transform(series: FloatArray, rate: float, inside: BoolArray) -> ComplexArray:
    """Return tapered transforms in bands (f, n), whose squares are densities, without a slope."""
    taper = tukey(len(series))
    scale = np.sqrt(2 / (rate * np.sum(taper**2)))
    transforms = [scale * np.fft.rfft(taper * detrend(column))[inside] for column in series.T]
    return np.stack(transforms, axis=1)


def _density(line: IdentifiedLine, frequency_hz: FloatArray, bin_hz: float) -> FloatArray:
    """Return the density of a line that the taper widens, (f,) [nm^2/Hz]."""
    centre = line.frequency_hz
    width = line.damping * centre + bin_hz / np.pi
    squares = (centre**2 - frequency_hz**2) ** 2 + (2 * width * frequency_hz) ** 2
    return np.asarray(line.rms_nm**2 * 4 * width * centre**2 / np.pi / squares)


def _make_bands(
    model: IdentifiedModel,
    lines: Sequence[IdentifiedLine],
    wavefront: FloatArray,
    readings: FloatArray,
) -> _Bands:
    """Return the bands of a stretch: readings, wavefront and its changes by gains."""
    rate, count = model.frame_rate_hz, len(readings)
    bin_hz = rate / count
    frequency = np.asarray(bin_hz * np.arange(count // 2 + 1), dtype=np.float64)
    inside = np.zeros(len(frequency), dtype=np.bool_)
    for line in lines:
        reach = _REACH * max(line.damping * line.frequency_hz, bin_hz)
        inside |= np.abs(frequency - line.frequency_hz) <= min(reach, line.frequency_hz / 4)
    f, axes = frequency[inside], len(model.axes)
    z, moved = np.split(_transform(wavefront, rate, inside), 2, axis=1)
    along = np.array([(line.direction or (1.0,))[:axes] for line in lines])
    # the mean acceleration over a frame, of the mean position in it
    swing = -1e-9 * (2 * np.pi * f) ** 2  # in m/s^2 a nm
    shapes = np.stack([_density(line, f, bin_hz) for line in lines], axis=1)
    background = [np.interp(f, a.frequency_hz, a.background_nm2_hz) for a in model.axes]
    narrow = np.array([line.kind == "line" for line in lines])  # the others are background
    total = np.einsum("fj,ja,jb->fab", shapes[:, narrow], along[narrow], along[narrow])
    total += np.stack(background, axis=1)[:, :, None] * np.eye(axes)
    root = np.linalg.cholesky(total)
    cross = np.transpose(shapes[:, :, None] * along, (0, 2, 1))  # (f, axes, lines)
    half = np.linalg.solve(root, cross) * swing[:, None, None]
    gain = np.linalg.solve(np.transpose(root, (0, 2, 1)), half)  # of the Wiener filter
    return _Bands(
        frames=count,
        bins=np.flatnonzero(inside),
        angle=2 * np.pi * f / rate,
        readings=_transform(readings, rate, inside),
        expected=np.einsum("faj,fa->fj", gain, z),
        moved=np.transpose(gain, (0, 2, 1)) * moved[:, None],
        seen=half,
        shapes=swing[:, None] ** 2 * shapes,
    )


def _lay_and_fit(
    model: IdentifiedModel,
    record: LoopRecord,
    lines: Sequence[IdentifiedLine],
    channels: Channels,
    largest: int,
    limit: float,
) -> tuple[int, _Fits, float, float]:
    """Return by how many frames readings were moved, fits, and the shift with its error."""
    gains = np.array(model.sensor_gains)
    errors = np.array([axis.sensor_gain_error or 0.0 for axis in model.axes])
    series = record.pseudo_open_loop(gains)
    wavefront = np.hstack([series, record.pseudo_open_loop(gains + errors) - series])

    def beside(lag: int) -> list[_Bands]:
        frames = np.arange(record.frames) + lag
        rows = np.clip(frames, 0, len(channels.good) - 1)
        usable = record.usable & (frames == rows) & channels.good[rows]
        bands = [
            _make_bands(model, lines, wavefront[start:stop], channels.values[rows[start:stop]])
            for start, stop in runs(usable).tolist()
            if stop - start >= SHORTEST_SEGMENT
        ]
        if not bands:
            raise ProblemError(
                f"record and accelerations must have {SHORTEST_SEGMENT} usable frames in a row "
                f"side by side; they have {record.frames} and {len(channels.good)} "
                "frames."
            )
        return bands

    bands = beside(0)
    lag = _likeliest_lag(bands, largest)
    fits = _fit_channels(beside(lag))
    late, error = _slope_shift(fits, limit)
    if not abs(lag + late) > DIFFERENT * error:  # not sure: they stay as they were given
        return 0, _fit_channels(bands), lag + late if np.isfinite(error) else 0.0, error
    if round(late):
        lag += round(late)
        fits = _fit_channels(beside(lag))
        late, error = _slope_shift(fits, limit)
    return lag, fits, lag + late, error


def _likeliest_lag(bands: Sequence[_Bands], largest: int) -> int:
    """Return the whole number of frames at which readings and wavefront agree best."""
    lags = np.arange(-largest, largest + 1)
    total = np.zeros(lags.size)
    for band in bands:
        covered = np.abs(lags) <= band.frames // 2
        for expected, reading in product(band.expected.T, band.readings.T):
            spectrum = np.zeros(band.frames, dtype=np.complex128)
            spectrum[band.bins] = expected.conj() * reading
            agreement = np.abs(band.frames * np.fft.ifft(spectrum)) ** 2
            power = max(float(np.sum(np.abs(spectrum) ** 2)), _TINY)
            total[covered] += agreement[lags[covered] % band.frames] / power
    return int(lags[np.argmax(total)])


class _Fits(NamedTuple):
    """Factors of channels for lines, (channels, lines) each; of one channel, (lines,)."""

    factors: ComplexArray
    along: FloatArray  # standard errors of them, along themselves: of the size
    across: FloatArray  # and across: of the phase, times the size
    chances: FloatArray  # that a channel without a line would show as much
    coherences: FloatArray
    noise: FloatArray  # density near each line [(m/s^2)^2/Hz]
    shifts: FloatArray  # lag by the slope of the phase within each line [frames]
    shift_weights: FloatArray  # their inverse variances


def _fit_channels(bands: Sequence[_Bands]) -> _Fits:
    """Fit the factors of all channels for all lines."""
    channels = range(bands[0].readings.shape[1])
    return _Fits(*map(np.array, zip(*(_fit_channel(bands, c) for c in channels), strict=True)))


def _fit_channel(bands: Sequence[_Bands], channel: int) -> _Fits:
    """Fit the factors of a channel for all lines, and test each of them."""
    x, moved, angle = (
        np.concatenate([getattr(band, name) for band in bands])
        for name in ("expected", "moved", "angle")
    )
    a = np.concatenate([band.readings[:, channel] for band in bands])
    noise = power = float(np.mean(np.abs(a) ** 2))
    opened, factors = np.zeros(len(a)), np.zeros(x.shape[1], dtype=np.complex128)
    for _ in range(_ROUNDS):
        # the median of an exponential law is ln 2 of its mean
        level = float(np.median(np.abs(a - x @ factors) ** 2 / (noise + opened)) / np.log(2))
        noise = max(noise * level, np.finfo(np.float64).eps * power)
        weights = 1 / (noise + opened)
        bread = np.linalg.pinv(x.conj().T @ (weights[:, None] * x), hermitian=True)
        factors = bread @ (x.conj().T @ (weights * a))
        opened = np.concatenate([band.open_power(factors) for band in bands])
    error = a - x @ factors
    slopes = -bread @ (x.conj().T @ (weights[:, None] * np.einsum("fja,j->fa", moved, factors)))
    power_seen = np.abs(x) ** 2
    shares = power_seen * weights[:, None]
    shares /= np.maximum(shares.sum(axis=0), _TINY)
    values = np.maximum(_INDEPENDENT / np.sum(shares**2, axis=0), 1.0)  # at each line
    degrees = np.maximum(values - 1, 0.5)
    excess = (np.abs(error) ** 2 * weights) @ shares
    inflation = np.maximum(excess * values / degrees, 1.0)
    # a channel with a motion of its own there
    doubtful = gammaincc(degrees, excess * values) < _DOUBT
    raised, degrees = np.where(doubtful, inflation, 1.0), np.where(doubtful, degrees, len(a))
    variances = np.diag(bread).real / _INDEPENDENT
    ratios = np.abs(factors) ** 2 / np.maximum(raised * variances, _TINY)
    rest = np.abs(error) ** 2 @ shares
    shown = np.abs(factors) ** 2 * np.sum(power_seen * shares, axis=0)
    scatter = variances * inflation / 2
    moves = slopes * np.exp(-1j * np.angle(factors))[:, None]
    # a small shift turns the phase in proportion to the distance from the middle of the line
    turn = -1j * (angle[:, None] - angle @ shares) * factors * x
    turned = np.maximum(np.sum(np.abs(turn) ** 2 * weights[:, None], axis=0), _TINY)
    return _Fits(
        factors=factors,
        along=np.sqrt(scatter + np.sum(moves.real**2, axis=1)),
        across=np.sqrt(scatter + np.sum(moves.imag**2, axis=1)),
        chances=np.exp(-degrees * np.log1p(ratios / degrees)),
        coherences=shown / np.maximum(shown + rest, _TINY),
        noise=noise * raised,
        shifts=np.real((weights * error) @ turn.conj()) / turned,
        shift_weights=2 * _INDEPENDENT * turned / inflation,
    )


def _slope_shift(fits: _Fits, limit: float) -> tuple[float, float]:
    """Return by how many frames readings are late beyond the lag, and its standard error."""
    shown = fits.chances < limit
    weights = fits.shift_weights[shown]
    if not weights.sum() > 0:
        return 0.0, float("inf")
    shift = float(weights @ fits.shifts[shown] / weights.sum())
    return shift, float(1 / np.sqrt(weights.sum()))
