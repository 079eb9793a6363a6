"""How each channel of accelerometers moves with each line of an identified model.

One regression: around each line, a Wiener filter with the spectra of the model estimates the line's
motion from the wavefront. Given the wavefront, the readings of a channel are normal with the mean
``expected F`` and the variance ``noise + open``: what the wavefront leaves open of the lines moves
the channel, too, and does not bias it. The factors F of all lines are found together with these
weights, in turn with the noise, whose median is robust against lines of the channel's own.

Readings may lag behind by some frames, which turns the phase of every frequency in proportion. They
are moved by whole frames if the slope of the phase within the lines is surely not that of readings
beside the wavefront. What is left of a shift is in the phases of the lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal.windows import tukey
from scipy.special import gammaincc

from lbt_synth.design import kalman
from lbt_synth.design.filter_design import MOST_UNITS
from lbt_synth.errors import DimensionError, LbtSynthError, ProblemError
from lbt_synth.identification.accelerometers.readings import fill_missing
from lbt_synth.identification.fit.identified_model import (
    DIFFERENT,
    IdentifiedLine,
    IdentifiedModel,
)
from lbt_synth.identification.records.faults import runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models import Accelerometer, Motion, SensorSuite
from lbt_synth.models.sensor_suite import LONGEST_DELAY
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray, number

_NM = 1e-9
_TINY = np.finfo(np.float64).tiny
_EXTRA = f"left out, because others show more and a design takes {MOST_UNITS - 1} channels"
_FEWEST_VALUES = 4  # a series of no more different numbers is rounding
_DEAD_M_S2 = 1e-9  # rms, a thousandth of what a quiet accelerometer resolves
_BLOCK_S = 100.0  # that is transformed at once, which bounds the memory for a long record
_TAPERED = 0.2  # of a block, at both ends together, against leakage of the turbulence
_INDEPENDENT = (1 - 5 * _TAPERED / 8) ** 2 / (1 - 93 * _TAPERED / 128)  # of tapered values
_SHORTEST = 256  # frames of a stretch that shows a line
_REACH = 20.0  # half widths of a line, or bins, from its centre to the edge of its band
_ROUNDS = 20  # of factors and noise, of which each brings them nearer by a factor of two or more
_DOUBT = 0.01  # chance below which a channel moves at a line more than its noise explains


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
    residual_nm: float = nm_column(
        "with the wavefront",
        format=".2f",
        default=float("nan"),
        help="Residual by the model of a Kalman filter of both",
    )


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
    rate_hz: float  # readings per second, after averaging
    alone_nm: float = float("nan")  # residual by the model of a Kalman filter of the wavefront
    together_nm: float = float("nan")  # and of one that reads all used channels, too

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
        return (
            f"the accelerometers lag behind the wavefront by {self.shift_frames:.3g} +- "
            f"{self.shift_error_frames:.2g} frames, by the slope of the phase within lines. Phases "
            f"hold for a shift of {self.age_frames - 1}."
        )

    @property
    def worth_text(self) -> str:
        """What the channels buy, in words; empty where none shows a line, or it is not known."""
        if not np.isfinite(self.together_nm):
            return ""
        return (
            "by the model, the Kalman filter of the wavefront leaves "
            f"{nm_text(self.alone_nm)}, and with {', '.join(row.channel for row in self.used)} "
            f"{nm_text(self.together_nm)}"
        )


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
    factor, whose size is the motion and whose angle the phase. In bands around the lines, the
    factors are those of a weighted regression of the channel on the lines as the wavefront shows
    them by the spectra of the model. What the wavefront leaves open of the lines is a second noise
    that grows with the factors. Standard errors count those of the model's sensor gains.

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
    readings, good = fill_missing(accelerations)
    names = _names(channels, readings.shape[1])
    if len(model.axes) != record.axes:
        raise DimensionError(
            f"model and record must have the same axes; got {len(model.axes)} and {record.axes}."
        )
    alarm = number(false_alarm, "false_alarm", above=0, below=1)
    largest = int(number(largest_shift_s, "largest_shift_s", at_least=0) * model.frame_rate_hz)
    live = [c for c, series in enumerate(readings.T) if _is_live(series[good])]
    places = [i for i, part in enumerate(model.parts) if part.kind == "line"]
    fits: list[_ChannelFit] = []
    shift, error, lag, limit = 0.0, float("inf"), 0, 0.0
    if live and places:
        lines = [model.parts[i] for i in places]
        widest = max(line.damping * line.frequency_hz for line in lines)
        shifts = 1 + np.ceil(4 * widest * largest / model.frame_rate_hz)  # that differ
        limit = alarm / (len(live) * len(lines) * shifts)
        lag, fits, (shift, error) = _lay_and_fit(
            model, record, lines, readings[:, live], good, largest, limit
        )
    rows = [
        _transfer_row(fit, j, names[c], places[j], model, limit)
        for c, fit in zip(live, fits, strict=False)
        for j in np.argsort([model.parts[place].frequency_hz for place in places]).tolist()
    ]
    noises = {
        names[c]: fit.noise_m_s2(model.frame_rate_hz, limit)
        for c, fit in zip(live, fits, strict=False)
    }
    shown = [row for row in rows if row.useful]
    best = _best_channels(shown, noises, model)
    transfers = AccelerometerTransfers(
        transfers=tuple(replace(row, useful=row.useful and row.channel in best) for row in rows),
        channels=tuple(
            ChannelRow(
                channel=name,
                noise_m_s2=noises.get(name, np.nan),
                verdict=_verdict(name, shown, name in best) if c in live else "dead",
            )
            for c, name in enumerate(names)
        ),
        shift_frames=shift,
        shift_error_frames=error,
        age_frames=lag + 1,
        rate_hz=model.frame_rate_hz,
    )
    if not best:
        return transfers
    try:
        return _with_residuals(transfers, model)
    except LbtSynthError:  # no filter of these sensors: the motions are not lost
        return transfers


def _is_live(readings: FloatArray) -> bool:
    """Return whether the readings (frames,) of a channel are more than rounding."""
    return np.unique(readings).size > _FEWEST_VALUES and float(np.std(readings)) > _DEAD_M_S2


def _names(channels: Sequence[str] | None, count: int) -> tuple[str, ...]:
    names = tuple(channels or (f"channel{c + 1}" for c in range(count)))
    if len(names) != count or len(set(names)) < count:
        raise ProblemError(
            f"channels must be {count} different names, one per column; got {', '.join(names)}."
        )
    return names


def _verdict(name: str, shown: Sequence[TransferRow], best: bool) -> str:
    """Return what a channel is used for, in words."""
    lines = [f"{row.frequency_hz:.3g}" for row in shown if row.channel == name]
    if not lines:
        return "adds nothing"
    use = f"{'used for' if best else 'shows'} {', '.join(lines)} Hz"
    return use if best else f"{_EXTRA}; {use}"


def _transfer_row(
    fit: _ChannelFit, j: int, name: str, place: int, model: IdentifiedModel, limit: float
) -> TransferRow:
    """Return what the fit of a channel says of one line."""
    factor, (error, across) = fit.factors[j], fit.errors(j)
    return TransferRow(
        channel=name,
        line=place,
        frequency_hz=model.parts[place].frequency_hz,
        motion_nm_per_nm=float(abs(factor)),
        motion_error_nm_per_nm=error,
        phase_deg=float(np.degrees(np.angle(factor))),
        phase_error_deg=float(min(np.degrees(across / max(abs(factor), _TINY)), 180.0)),
        coherence=float(fit.coherences[j]),
        chance=float(fit.chances[j]),
        useful=bool(fit.chances[j] < limit),
    )


def _best_channels(
    shown: Sequence[TransferRow], noises: Mapping[str, float], model: IdentifiedModel
) -> list[str]:
    """Return the channels that tell most of the lines' power, as many as a design takes."""
    worth = dict.fromkeys((row.channel for row in shown), 0.0)
    for row in shown:
        line = model.parts[row.line]
        size = _NM * (2 * np.pi * line.frequency_hz) ** 2 * line.rms_nm * row.motion_nm_per_nm
        signal = (size / max(noises[row.channel], _TINY)) ** 2
        worth[row.channel] += line.rms_nm**2 * float(np.log1p(signal))
    return sorted(worth, key=lambda name: -worth[name])[: MOST_UNITS - 1]


def _with_residuals(
    transfers: AccelerometerTransfers, model: IdentifiedModel
) -> AccelerometerTransfers:
    """Add what a Kalman filter leaves by the model without channels, with each, and with all."""
    plant, age = model.plant(), transfers.loop_age(model.delay_frames)

    def residual_nm(channels: Sequence[ChannelRow]) -> float:
        instrument = Accelerometer(
            name="accelerometer",
            rate_hz=transfers.rate_hz,
            delay_frames=age + model.delay_frames - 1,
            channels=tuple(row.channel for row in channels),
            noise_m_s2=np.array([row.noise_m_s2 for row in channels]),
        )
        motions: list[dict[str, Motion]] = [{} for _ in model.parts]
        for row in transfers.transfers:
            if row.useful and row.channel in instrument.channels:
                motion = Motion(size=row.motion_nm_per_nm, phase_deg=row.phase_deg)
                motions[row.line][row.channel] = motion
        return kalman(plant.with_sensors(SensorSuite(sensors=(instrument,)), tuple(motions))).rms

    rows = [
        replace(row, residual_nm=residual_nm([row])) if row in transfers.used else row
        for row in transfers.channels
    ]
    together_nm = residual_nm(transfers.used)
    alone_nm = kalman(plant).rms
    return replace(transfers, channels=tuple(rows), alone_nm=alone_nm, together_nm=together_nm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Bands:
    """Frequencies of a block of a record around all lines; densities per Hz."""

    frames: int  # of the block
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


def _transform(series: FloatArray, rate: float) -> ComplexArray:
    """Return tapered transforms (f, n), whose squares are densities, without mean and slope."""
    time = np.linspace(-1, 1, len(series))
    level = series - series.mean(axis=0) - np.outer(time, time @ series / (time @ time))
    taper = tukey(len(series), _TAPERED)
    scale = np.sqrt(2 / (rate * np.sum(taper**2)))
    return np.asarray(scale * np.fft.rfft(taper[:, None] * level, axis=0))


def _density(line: IdentifiedLine, frequency_hz: FloatArray, bin_hz: float) -> FloatArray:
    """Return the density of a line that the taper widens, (f,) [nm^2/Hz].

    The peak of a line narrower than a bin is that of its tapered power, nearly ``rms^2 / bin``.
    """
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
    """Return the bands of a block of readings and of the wavefront beside its changes by gains."""
    rate, count = model.frame_rate_hz, len(readings)
    bin_hz = rate / count
    frequency = np.asarray(bin_hz * np.arange(count // 2 + 1), dtype=np.float64)
    inside = np.zeros(len(frequency), dtype=np.bool_)
    for line in lines:
        reach = _REACH * max(line.damping * line.frequency_hz, bin_hz)
        inside |= np.abs(frequency - line.frequency_hz) <= min(reach, line.frequency_hz / 4)
    f, axes = frequency[inside], len(model.axes)
    z, moved = np.split(_transform(wavefront, rate)[inside], 2, axis=1)
    along = np.array([(line.direction or (1.0,))[:axes] for line in lines])
    # the mean acceleration over a frame, of the mean position in it
    swing = -_NM * (2 * np.pi * f) ** 2
    shapes = np.stack([_density(line, f, bin_hz) for line in lines], axis=1)
    background = [np.interp(f, a.frequency_hz, a.background_nm2_hz) for a in model.axes]
    total = np.einsum("fj,ja,jb->fab", shapes, along, along)
    total += np.stack(background, axis=1)[:, :, None] * np.eye(axes)
    root = np.linalg.cholesky(total)
    cross = np.transpose(shapes[:, :, None] * along, (0, 2, 1))  # (f, axes, lines)
    half = np.linalg.solve(root, cross) * swing[:, None, None]
    gain = np.linalg.solve(np.transpose(root, (0, 2, 1)), half)  # of the Wiener filter
    return _Bands(
        frames=count,
        bins=np.flatnonzero(inside),
        angle=2 * np.pi * f / rate,
        readings=_transform(readings, rate)[inside],
        expected=np.einsum("faj,fa->fj", gain, z),
        moved=np.transpose(gain, (0, 2, 1)) * moved[:, None],
        seen=half,
        shapes=swing[:, None] ** 2 * shapes,
    )


def _lay_and_fit(
    model: IdentifiedModel,
    record: LoopRecord,
    lines: Sequence[IdentifiedLine],
    readings: FloatArray,
    good: BoolArray,
    largest: int,
    limit: float,
) -> tuple[int, list[_ChannelFit], tuple[float, float]]:
    """Lay readings beside the wavefront: with the likeliest shift, or as given if that is not sure.

    Return by how many frames they were moved, the fits, and the shift with its standard error.
    """
    gains = np.array(model.sensor_gains)
    errors = np.array([axis.sensor_gain_error or 0.0 for axis in model.axes])
    series = record.pseudo_open_loop(gains)
    wavefront = np.hstack([series, record.pseudo_open_loop(gains + errors) - series])

    def beside(lag: int) -> list[_Bands]:
        frames = np.arange(record.frames) + lag
        rows = np.clip(frames, 0, len(readings) - 1)
        usable = record.usable & (frames == rows) & good[rows]
        blocks = []
        for start, stop in runs(usable).tolist():
            if stop - start >= _SHORTEST:
                count = int(np.ceil((stop - start) / (_BLOCK_S * model.frame_rate_hz)))
                edges = np.linspace(start, stop, count + 1).astype(int).tolist()
                blocks += [slice(a, b) for a, b in pairwise(edges)]
        if not blocks:
            raise ProblemError(
                f"record and accelerations must have {_SHORTEST} usable frames in a row side by "
                f"side; they have {record.frames} and {len(readings)} frames."
            )
        return [_make_bands(model, lines, wavefront[x], readings[rows[x]]) for x in blocks]

    def fit(bands: Sequence[_Bands], lag: int) -> tuple[list[_ChannelFit], float, float]:
        fits = [_fit_channel(bands, channel) for channel in range(readings.shape[1])]
        slope, error = _slope_shift(fits, limit)
        return fits, lag + slope, error

    bands = beside(0)
    likeliest = _likeliest_lag(bands, largest)
    fits, shift, error = fit(beside(likeliest), likeliest)
    if abs(shift) > DIFFERENT * error:
        lag = round(shift)
        fits, shift, error = fit(beside(lag), lag)
        return lag, fits, (shift, error)
    if likeliest:
        fits, *_ = fit(bands, 0)
    return 0, fits, (shift if np.isfinite(error) else 0.0, error)


def _likeliest_lag(bands: Sequence[_Bands], largest: int) -> int:
    """Return the whole number of frames at which readings and wavefront agree best."""
    lags = np.arange(-largest, largest + 1)
    total = np.zeros(lags.size)
    for band in bands:
        near = np.abs(lags) <= band.frames // 2
        for expected in band.expected.T:
            for reading in band.readings.T:
                product = expected.conj() * reading
                spectrum = np.zeros(band.frames, dtype=np.complex128)
                spectrum[band.bins] = product
                agreement = np.abs(band.frames * np.fft.ifft(spectrum)) ** 2
                power = max(float(np.sum(np.abs(product) ** 2)), _TINY)
                total[near] += agreement[lags[near] % band.frames] / power
    return int(lags[np.argmax(total)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ChannelFit:
    """Factors of one channel for all lines."""

    factors: ComplexArray  # (lines,)
    variances: FloatArray  # (lines,): of the complex factors, for the gains of the model
    slopes: ComplexArray  # (lines, axes): of the factors, for a standard error of each sensor gain
    chances: FloatArray  # (lines,): that a channel without a line would show as much
    coherences: FloatArray  # (lines,)
    noise: FloatArray  # (lines,): density near each line [(m/s^2)^2/Hz]
    shifts: FloatArray  # (lines,): lag by the slope of the phase within each line [frames]
    shift_weights: FloatArray  # (lines,): their inverse variances

    def errors(self, j: int) -> tuple[float, float]:
        """Return the standard errors of a factor along itself, and across: of size and phase."""
        turned = self.slopes[j] * np.exp(-1j * np.angle(self.factors[j]))
        scatter = self.variances[j] / 2
        along, across = (np.sqrt(scatter + np.sum(x**2)) for x in (turned.real, turned.imag))
        return float(along), float(across)

    def noise_m_s2(self, rate: float, limit: float) -> float:
        """Return the noise of a reading near the lines that the channel shows, or near all."""
        shown = self.chances < limit
        return float(np.sqrt(np.mean(self.noise[shown if shown.any() else ...]) * rate / 2))


def _fit_channel(bands: Sequence[_Bands], channel: int) -> _ChannelFit:
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
    shares = np.abs(x) ** 2 * weights[:, None]
    shares /= np.maximum(shares.sum(axis=0), _TINY)
    values = np.maximum(_INDEPENDENT / np.sum(shares**2, axis=0), 1.0)  # at each line
    degrees = np.maximum(values - 1, 0.5)
    excess = (np.abs(error) ** 2 * weights) @ shares
    doubtful = gammaincc(degrees, excess * values) < _DOUBT
    more = np.maximum(excess * values / degrees, 1.0)  # a channel with a motion of its own there
    variances = np.diag(bread).real / _INDEPENDENT
    ratios = np.abs(factors) ** 2 / np.maximum(variances, _TINY)
    ratios, degrees = np.where(
        doubtful, [ratios / more, degrees], [ratios, np.full_like(more, len(a))]
    )
    left = np.abs(error) ** 2 @ shares
    shown = np.abs(factors) ** 2 * np.sum(np.abs(x) ** 2 * shares, axis=0)
    # a small shift turns the phase in proportion to the distance from the middle of the line
    turn = -1j * (angle[:, None] - angle @ shares) * factors * x
    size = np.maximum(np.sum(np.abs(turn) ** 2 * weights[:, None], axis=0), _TINY)
    return _ChannelFit(
        factors=factors,
        variances=variances * more,
        slopes=slopes,
        chances=np.exp(-degrees * np.log1p(ratios / degrees)),
        coherences=shown / np.maximum(shown + left, _TINY),
        noise=noise * np.where(doubtful, more, 1.0),
        shifts=np.real((weights * error) @ turn.conj()) / size,
        shift_weights=2 * _INDEPENDENT * size / more,
    )


def _slope_shift(fits: Sequence[_ChannelFit], limit: float) -> tuple[float, float]:
    """Return by how many frames readings are late beyond the lag, and its standard error."""
    shown = [fit.chances < limit for fit in fits]
    weights = np.concatenate([fit.shift_weights[s] for fit, s in zip(fits, shown, strict=True)])
    shifts = np.concatenate([fit.shifts[s] for fit, s in zip(fits, shown, strict=True)])
    if not weights.sum() > 0:
        return 0.0, float("inf")
    return float(weights @ shifts / weights.sum()), float(1 / np.sqrt(weights.sum()))
