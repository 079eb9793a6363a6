"""Records of tip and tilt: measurements with commands and their usable frames, or spectra."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT
from lbt_synth.identification.records.faults import Finding, findings_in, mark, runs
from lbt_synth.models import LoopHardware, PositionLoop, TabulatedSpectrum
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.validation import (
    BoolArray,
    Count,
    FloatArray,
    Obstruction,
    Positive,
    check_fields,
    each_of,
    frozen_copy,
    integer,
    matrix,
    number,
    read_only,
    real_array,
    set_fields,
)

BRIDGED_FRAMES = 3  # of a hole, over which a slow phase is a cubic
FEW = 0.01  # of the frames, that may have a fault or be bridged: they move no result
NOT_KNOWN = "correction not known"
Stretches: TypeAlias = tuple[tuple[int, int], ...]  # (start, stop) of contiguous usable frames
_Delay: TypeAlias = Annotated[float, ("at_least", 1), ("at_most", 100)]
_LEAST_FRAMES = 4 * SHORTEST_SEGMENT  # half of which show a model to be tested on the others
LEAST_SECONDS = 2.0  # slower turbulence moves no filter by much


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopRecord:
    """What a loop recorded of one or two axes, in nm of wavefront on a regular grid of frames.

    In the convention of :class:`LoopHardware`, with the mirror's taps of delay and dynamics::

        y(k) = gain (phi_tot(k-1) - c(k)) + w(k),   c(k) = taps[0] u(k-1) + taps[1] u(k-2) + ...

    :func:`loop_record` and :func:`load_record` make records, find their faults and describe the
    facts that are fields here. A frame is usable if its measurement is good, and every command in
    its correction, or if it is a bridge.

    Attributes
    ----------
    measurements, commands : (frames, axes) arrays, the second or None
        Measurements y(k) and commands u(k) [nm]; the pseudo-open-loop series itself, without
        commands.
    measured, commanded, bridges, usable : (frames,) bool arrays
        Frames whose measurement is good, whose command is, whose pseudo-open loop was interpolated,
        and that count. The others hold finite fillers.
    faults, notes : tuple of Finding, tuple of str
        What was found in the series; how they were read, and what changes with time.
    imaging_wavelength_um : float or None
        Wavelength of the image [um].
    shown_unit : str
        Unit in which people see the wavefront: nm, um, mas or urad.
    stated_gain, read_with : tuple of float, str
        Sensor gain of all axes, or of each, as somebody knows it; options by which the commands
        were made those that the mirror followed.

    Raises
    ------
    ProblemError
        If sizes clash, or a value is not finite or out of range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> seen = lbt.identification.loop_record(
    ...     [[4.0], [3.0], [1.0], [2.0]],
    ...     [[0.0], [5.0], [6.0], [7.0]],
    ...     frame_rate_hz=800,
    ...     delay_frames=2,
    ...     unit="nm",
    ... )
    >>> seen.corrections()[:, 0].tolist()  # u(k-2); the first two are not known
    [0.0, 0.0, 0.0, 5.0]
    >>> seen.pseudo_open_loop(sensor_gain=0.5)[:, 0].tolist()
    [8.0, 6.0, 2.0, 9.0]
    >>> seen.stretches()
    ((2, 4),)
    """

    frame_rate_hz: Positive
    measurements: FloatArray
    commands: FloatArray | None = None
    delay_frames: _Delay | None = None
    mirror: PositionLoop | None = None
    measured: BoolArray
    commanded: BoolArray
    faults: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()
    diameter_m: Positive | None = None
    obstruction: Obstruction | None = None
    imaging_wavelength_um: Positive | None = None
    shown_unit: str = "nm"
    source: str = ""
    bridges: BoolArray | None = None
    stated_gain: tuple[float, ...] = ()
    read_with: str = ""
    usable: BoolArray = field(init=False)

    def __repr__(self) -> str:
        """Return three lines: what was recorded, how the loop ran, and what is usable."""
        series = "measurements" if self.commands is None else "measurements and commands"
        delay = "unknown" if self.delay_frames is None else f"{self.delay_frames:g} frames"
        return (
            f"<LoopRecord of {self.source or 'series'}: {self.frames} frames of {series},\n"
            f" {self.axes} axes at {self.frame_rate_hz:g} Hz, delay {delay},\n"
            f" {self.summary()}>"
        )

    def __post_init__(self) -> None:
        y = matrix(self.measurements, "measurements")
        check_fields(self, measurements=y)
        if not 1 <= y.shape[1] <= 2 or len(y) == 0:
            raise DimensionError(
                f"measurements must be (frames, axes) of one or two axes; got {y.shape}."
            )
        if self.commands is not None:
            why = f"to match measurements {y.shape}"
            u = matrix(self.commands, "commands", rows=(len(y), why), cols=(y.shape[1], why))
            set_fields(self, commands=u)
        for name in ("measured", "commanded", "bridges"):
            if (value := getattr(self, name)) is not None:
                flags = read_only(np.array(value))
                if flags.dtype != np.bool_ or flags.shape != (len(y),):
                    raise DimensionError(
                        f"{name} must be {len(y)} truth values, one per frame; got {flags.dtype} "
                        f"{flags.shape}."
                    )
                set_fields(self, **{name: flags})
        usable = self.measured & ~self.unknown_corrections()
        if self.bridges is not None:
            usable |= self.bridges
        set_fields(self, usable=read_only(usable))

    def unknown_corrections(self) -> BoolArray:
        """Return the frames whose correction contains a spoilt command, or one from before."""
        unknown = np.zeros(self.frames, dtype=np.bool_)
        if self.delay_frames is not None:
            taps = self.mirror_taps  # refuses a mirror that does not fit the rate
            if self.commands is not None:
                spoilt = np.convolve(~self.commanded, [0, *(taps != 0)])
                unknown = np.asarray(spoilt[: self.frames] > 0)
                unknown[: len(taps)] = True
        return unknown

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was found in the record; empty for a clean one."""
        return self.faults + findings_in(self.unknown_corrections(), NOT_KNOWN, "frames")

    def summary(self) -> str:
        """Return one line: how many frames are usable, and why the others are not."""
        usable = f"{int(np.sum(self.usable))} of {self.frames} frames are usable"
        spoilt = [f"{f.count} {f.kind} ({f.series})" for f in self.findings]
        return f"{'; '.join(filter(None, (usable, ', '.join(spoilt))))}."

    @property
    def frames(self) -> int:
        """Number of frames, those that are not usable included."""
        return len(self.measurements)

    @property
    def axes(self) -> int:
        """Number of axes, 1 or 2."""
        return int(self.measurements.shape[1])

    @property
    def duration_s(self) -> float:
        """Length of the record [s]."""
        return self.frames / self.frame_rate_hz

    @property
    def first_known(self) -> int:
        """First frame whose correction has no command from before the record."""
        closed = self.commands is not None and self.delay_frames is not None
        return len(self.mirror_taps) if closed else 0

    @property
    def lost(self) -> float:
        """Part of the frames that is spoilt, of those whose commands the record has."""
        return float(1 - np.mean(self.usable[min(self.first_known, self.frames - 1) :]))

    @property
    def hardware(self) -> LoopHardware:
        """The loop of a known delay: its mirror, one measurement and one command per axis."""
        if self.delay_frames is None:
            raise ProblemError(
                "the total delay of this loop is not known; give delay_frames, from the middle of "
                "an exposure to the middle of the command that is computed from it."
            )
        return LoopHardware(
            frame_rate_hz=self.frame_rate_hz,
            delay_frames=self.delay_frames,
            modes=self.axes,
            mirror=self.mirror,
        )

    @property
    def mirror_taps(self) -> FloatArray:
        """Weights of u(k-1), u(k-2), ... in the correction that y(k) sees."""
        return self.hardware.mirror_taps

    def corrections(self) -> FloatArray:
        """Return the correction c(k) inside each measurement, (frames, axes) [nm].

        ``c(k) = taps[0] u(k-1) + taps[1] u(k-2) + ...``; zeros of an open loop. The first
        ``len(mirror_taps)`` rows are not known, and those frames not usable. A closed loop has to
        have a known delay.
        """
        if self.commands is None:
            return np.zeros(self.measurements.shape)
        return past_corrections(self.mirror_taps, self.commands)

    def pseudo_open_loop(self, sensor_gain: ArrayLike = 1.0) -> FloatArray:
        """Return the measurements that an open loop would have given, (frames, axes) [nm].

        They are ``y(k)/gain + c(k) = phi_tot(k-1) + w(k)/gain``, with one real gain of the sensor
        or one per axis. A closed loop has to have a known delay.
        """
        return np.asarray(self.measurements / self.known_gains(sensor_gain) + self.corrections())

    def known_gains(self, sensor_gain: ArrayLike) -> FloatArray:
        """Return the gain of each axis, (axes,), from one for all, alone or in a list, or each."""
        return each_of(sensor_gain, "sensor_gain", self.axes, above=0)

    def stretches(self) -> tuple[tuple[int, int], ...]:
        """Return (start, stop) of each stretch of contiguous usable frames."""
        return tuple((int(start), int(stop)) for start, stop in runs(self.usable))

    def with_delay(self, delay_frames: float | None) -> LoopRecord:
        """Return the same record of a loop with another total delay [frames], without bridges."""
        return replace(self, delay_frames=delay_frames, bridges=None)

    def bridged(self, *, sensor_gain: ArrayLike = 1.0) -> LoopRecord:
        """Return the record with short holes interpolated, and a note.

        A cubic spline through the pseudo-open-loop measurements for this sensor gain fills the
        holes of at most 3 frames, if they are no more than 1 % of the record.
        """
        series, frame = self.pseudo_open_loop(sensor_gain), np.arange(self.frames)
        holes = runs(~self.usable)
        inside = (holes[:, 0] > 0) & (holes[:, 1] < self.frames)
        holes = holes[inside & (holes[:, 1] - holes[:, 0] <= BRIDGED_FRAMES)]
        bridges = mark(holes, self.frames)
        count = int(np.sum(bridges))
        if not 0 < count <= FEW * self.frames or self.bridges is not None:
            return self
        series[bridges] = CubicSpline(frame[self.usable], series[self.usable])(frame[bridges])
        y = self.known_gains(sensor_gain) * (series - self.corrections())
        note = f"{count} frames in {len(holes)} holes of at most {BRIDGED_FRAMES} were interpolated"
        return replace(
            self,
            measurements=np.where(bridges[:, None], y, self.measurements),
            measured=self.measured & ~bridges,  # a replaced measurement is none of another delay
            bridges=bridges,
            notes=(*self.notes, note),
        )


def require_length(
    record: LoopRecord, *, frames: int = _LEAST_FRAMES, seconds: float = LEAST_SECONDS
) -> int:
    """Return the usable frames in stretches of at least 256; refuse a record with too few."""
    rate = record.frame_rate_hz
    needed = integer(frames, "frames", at_least=1)
    needed = max(needed, int(np.ceil(rate * number(seconds, "seconds", at_least=0) * (1 - 1e-12))))
    before = record.first_known
    lengths = [stop - (start if start > before else 0) for start, stop in record.stretches()]
    count = sum(length for length in lengths if length >= SHORTEST_SEGMENT)
    longest = max(lengths, default=0)
    if count < needed:
        raise ProblemError(
            f"the record needs {needed} usable frames ({needed / rate:.3g} s at {rate:.6g} Hz) in "
            f"stretches of at least {SHORTEST_SEGMENT}; got {count} ({count / rate:.3g} s), the "
            f"longest stretch {longest}. {record.summary()} Record for longer, or lose "
            "fewer frames."
        )
    return count


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpectrumRecord:
    """One-sided power spectra of one or two axes.

    Parameters
    ----------
    frequency_hz : (f,) array_like
        Increasing frequencies, at least 0 [Hz].
    density_nm2_hz : (f, axes) array_like
        Densities [nm^2/Hz], at least 0, of the disturbance in open loop; integrated over the
        frequencies above 0 they give the variance.
    frame_rate_hz : float, optional
        Frame rate of the loop [Hz].
    averages : int, optional
        Periodograms that were averaged.
    diameter_m : float, optional
        Telescope diameter [m].
    shown_unit : str, optional
        Unit in which people see the wavefront: nm, um, mas or urad.
    source : str, optional
        Where it is from.
    notes : tuple of str, optional
        How the file was read.

    Raises
    ------
    ProblemError
        If frequencies do not increase, a density is negative, or sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> flat = lbt.identification.SpectrumRecord(
    ...     frequency_hz=[0, 50, 100], density_nm2_hz=[[4], [4], [4]]
    ... )
    >>> flat.rms_nm.tolist(), flat.axes
    ([20.0], 1)
    """

    frequency_hz: FloatArray
    density_nm2_hz: FloatArray
    frame_rate_hz: Positive | None = None
    averages: Count | None = None
    diameter_m: Positive | None = None
    shown_unit: str = "nm"
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        density: Any = real_array(self.density_nm2_hz, "density_nm2_hz")
        density = matrix(density[:, None] if density.ndim == 1 else density, "density_nm2_hz")
        frequency = real_array(self.frequency_hz, "frequency_hz")
        if frequency.shape != density.shape[:1] or not 1 <= density.shape[1] <= 2:
            raise DimensionError(
                "density_nm2_hz must have a row per frequency, and one or two axes; got "
                f"{density.shape} and {frequency.shape} frequencies."
            )
        for column in density.T:
            TabulatedSpectrum(frequency_hz=frequency, density_nm2_hz=column)
        check_fields(self, frequency_hz=frequency, density_nm2_hz=density)

    @property
    def axes(self) -> int:
        """Number of axes, 1 or 2."""
        return int(self.density_nm2_hz.shape[1])

    @property
    def rms_nm(self) -> FloatArray:
        """Root of the integral over the frequencies of the record, (axes,) [nm]."""
        middles = (self.density_nm2_hz[1:] + self.density_nm2_hz[:-1]) / 2
        return frozen_copy(np.sqrt(np.diff(self.frequency_hz) @ middles))


def keep_frames(record: LoopRecord, kept: BoolArray) -> LoopRecord:
    """Return a record of which no other frames (frames,) are usable."""
    bridges = None if record.bridges is None else record.bridges & kept
    return replace(record, measured=record.measured & kept, bridges=bridges)


def split_halves(record: LoopRecord) -> tuple[LoopRecord, LoopRecord]:
    """Return a record with the first half of its usable frames, to fit, and the rest, to test."""
    runs = record.stretches()
    count = int(np.sum(record.usable))
    if count < 2:
        raise ProblemError(
            f"a record must leave frames to fit and to test on; got {count} usable frames. Record "
            "more."
        )
    first = mark(np.array(cut_stretches(runs, 0, count // 2)), record.frames)
    return keep_frames(record, first), keep_frames(record, ~first)


def cut_stretches(stretches: Stretches, first: int, last: int) -> Stretches:
    """Return the usable frames from one count of them to another."""
    out, before = [], 0
    for start, stop in stretches:
        low, high = max(first - before, 0), min(last - before, stop - start)
        if low < high:
            out.append((start + low, start + high))
        before += stop - start
    return tuple(out)
