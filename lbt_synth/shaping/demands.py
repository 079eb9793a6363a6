"""What a shaped loop must keep to: margins, masks, stability against what is not known.

Each demand turns into convex constraints at given frequencies, drawn in by a little room,
and into checks of the real loop over all frequencies that know nothing of the programme.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from lbt_synth.certify import Check
from lbt_synth.cones import Bounded, Constraint, Discs, Fractions, HalfPlanes
from lbt_synth.errors import ProblemError
from lbt_synth.loop.budget import resonance_edges
from lbt_synth.models.hardware import LoopHardware
from lbt_synth.models.truth import Spectrum
from lbt_synth.norms import band_norm, hinf_norm, largest_real_part
from lbt_synth.quadrature import adaptive_integral
from lbt_synth.shaping.band import Band
from lbt_synth.shaping.channel import Channel
from lbt_synth.shaping.grid import Grid, spectrum_edges
from lbt_synth.shaping.measured import MeasuredLoop, through_taps
from lbt_synth.shaping.terms import ResidualVariance
from lbt_synth.statespace import StateSpace
from lbt_synth.validation import ComplexArray, FloatArray, number

ROOM = 1e-3  # part of a bound that the programme leaves unused, for what lies between its points
_LEVEL_SETS = "level sets, all frequencies"


@dataclass(frozen=True, slots=True, kw_only=True)
class ModulusMargin:
    """Least distance of the loop from instability, ``1 / max |S|``, at unit sensor gain.

    Parameters
    ----------
    at_least : float
        The margin, in (0, 1).

    Raises
    ------
    ProblemError
        If it is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.ModulusMargin(at_least=0.45).label
    'modulus margin of at least 0.45'
    """

    at_least: float

    def __post_init__(self) -> None:
        margin = number(self.at_least, "at_least", above=0, below=1)
        object.__setattr__(self, "at_least", margin)

    @property
    def label(self) -> str:
        """What a message calls it."""
        return f"modulus margin of at least {self.at_least:g}"

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz
        rows = channel.complementary_rows(f)
        return (_discs(f, -rows, np.ones(len(rows)), (1 - ROOM) / self.at_least),)

    def checks(self, loop: MeasuredLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        return (
            Check(
                name="peak of the sensitivity",
                value=hinf_norm(loop.sensitivity).upper,
                limit=1 / self.at_least,
                method=_LEVEL_SETS,
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisePeak:
    """Largest amplification of measurement noise into the residual, at any frequency.

    Parameters
    ----------
    at_most : float
        The amplification at unit sensor gain.

    Raises
    ------
    ProblemError
        If it is not positive.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.NoisePeak(at_most=2).at_most
    2.0
    """

    at_most: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "at_most", number(self.at_most, "at_most", above=0))

    @property
    def label(self) -> str:
        """What a message calls it."""
        return f"noise amplified by at most {self.at_most:g}"

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz
        rows = channel.noise_rows(f)
        return (_discs(f, rows, np.zeros(len(rows)), (1 - ROOM) * self.at_most),)

    def checks(self, loop: MeasuredLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        return (
            Check(
                name="peak of the noise transfer",
                value=hinf_norm(loop.at(1.0).noise_propagation()).upper,
                limit=self.at_most,
                method=_LEVEL_SETS,
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Attenuation(Band):
    """Bound on the rejection over a band: one step of a mask.

    Exact at any sensor gain g: ``|1 - T| <= a |1 - (1 - g) T|`` is a disc of T for
    ``a |1 - g| < 1``.

    Parameters
    ----------
    low_hz, high_hz : float
        Ends of the band [Hz].
    at_most : float
        Largest residual for a unit disturbance.
    sensor_gain : float, optional
        Sensor gain at which it holds.

    Raises
    ------
    ProblemError
        If a value is out of its range, or the bound is too loose to be convex at this gain.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.Attenuation(low_hz=0, high_hz=2, at_most=0.01).label
    'attenuation to 0.01 in 0-2 Hz at sensor gain 1'
    """

    at_most: float
    sensor_gain: float = 1.0

    def __post_init__(self) -> None:
        Band.__post_init__(self)
        set_ = object.__setattr__
        set_(self, "at_most", number(self.at_most, "at_most", above=0))
        set_(self, "sensor_gain", number(self.sensor_gain, "sensor_gain", above=0))
        if not self.at_most * abs(1 - self.sensor_gain) < 1:
            raise ProblemError(
                f"at_most must be below {1 / abs(1 - self.sensor_gain):.6g} at sensor gain "
                f"{self.sensor_gain:g}, where it is no convex bound; got {self.at_most:g}."
            )

    @property
    def label(self) -> str:
        """What a message calls it."""
        return (
            f"attenuation to {self.at_most:g} in {self.band_text} "
            f"at sensor gain {self.sensor_gain:g}"
        )

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.within(self.low_hz, self.high_hz)
        rows = channel.complementary_rows(f)
        rest = 1 - self.sensor_gain
        # near the edge of convexity a small part of the disc's radius is a large one of the bound
        stretch = (1 + self.at_most * abs(rest)) / (1 - self.at_most * abs(rest))
        a = (1 - min(ROOM * stretch, 0.05)) * self.at_most
        curvature = 1 - (a * rest) ** 2
        centre = (1 - a**2 * rest) / curvature
        return (_discs(f, -rows, np.full(f.size, centre), a * self.sensor_gain / curvature),)

    def checks(self, loop: MeasuredLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        rejection = loop.at(self.sensor_gain).rejection()
        return (
            Check(
                name=f"rejection in {self.band_text} at sensor gain {self.sensor_gain:g}",
                value=band_norm(rejection, self.low_hz, self.high_hz).upper,
                limit=self.at_most,
                method="level sets, all of the band",
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorGainRange:
    """Guaranteed stability for every sensor gain of an interval.

    The loop is stable at g while ``1 - (1 - g) T`` does not vanish: the real part of T is
    kept below ``1 / (1 - low)`` and above ``-1 / (high - 1)``, which is convex.

    Parameters
    ----------
    low, high : float
        Ends of the interval, around 1 (the gain that is designed for).

    Raises
    ------
    ProblemError
        If the interval does not hold 1, or is not positive.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.SensorGainRange(low=0.25, high=1.3).label
    'stability for sensor gains 0.25 to 1.3'
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        hint = "The range must hold 1, the gain that is designed for; set model.sensor_gain."
        set_ = object.__setattr__
        set_(self, "low", number(self.low, "low", above=0, at_most=1, hint=hint))
        set_(self, "high", number(self.high, "high", at_least=1, hint=hint))

    @property
    def label(self) -> str:
        """What a message calls it."""
        return f"stability for sensor gains {self.low:g} to {self.high:g}"

    def _bounds(self) -> tuple[tuple[float, float], ...]:
        """Signs and bounds of the real part of T."""
        ends = ((1.0, 1 - self.low), (-1.0, self.high - 1))
        return tuple((sign, 1 / change) for sign, change in ends if change > 0)

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz
        rows = channel.complementary_rows(f).real
        return tuple(
            HalfPlanes(frequency_hz=f, rows=sign * rows, bounds=np.full(f.size, (1 - ROOM) * bound))
            for sign, bound in self._bounds()
        )

    def checks(self, loop: MeasuredLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        T = loop.complementary
        return tuple(
            Check(
                name="real part of the complementary sensitivity, "
                + ("largest" if sign > 0 else "least, negated"),
                value=largest_real_part(
                    StateSpace(A=T.A, B=T.B, C=sign * T.C, D=sign * T.D, dt_s=T.dt_s)
                ),
                limit=bound,
                method=_LEVEL_SETS,
            )
            for sign, bound in self._bounds()
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayError:
    """Guaranteed stability for every error of the delay up to a bound, late or early.

    Delays, fractions included, are those of :class:`LoopHardware`: with the mirror's response
    ``M_d`` at a delay d, the loop stays stable at ``d + e`` while
    ``|M_(d+e) - M_d| |Q| < 1``. The response is piecewise linear in e, so the ends of the
    interval and the whole delays within it stand for all of it. A delay below one frame does
    not occur.

    Parameters
    ----------
    frames : float
        Largest error [frames], at most 1.

    Raises
    ------
    ProblemError
        If it is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.DelayError(frames=0.25).frames
    0.25
    """

    frames: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", number(self.frames, "frames", above=0, at_most=1))

    @property
    def label(self) -> str:
        """What a message calls it."""
        return f"stability for delay errors up to {self.frames:g} frames"

    def _differences(self, hardware: LoopHardware) -> list[tuple[float, FloatArray]]:
        """Delays that stand for all, and the taps of ``M_(d+e) - M_d``."""
        d = hardware.delay_frames
        low, high = max(d - self.frames, 1.0), d + self.frames
        whole = np.arange(np.ceil(low), np.floor(high) + 1)
        out = []
        for other in np.unique(np.concatenate([[low, high], whole])):
            if other != d:
                there = replace(hardware, delay_frames=float(other)).mirror_taps
                taps = np.zeros(max(there.size, hardware.mirror_taps.size))
                taps[: there.size] += there
                taps[: hardware.mirror_taps.size] -= hardware.mirror_taps
                out.append((float(other), taps))
        return out

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz
        rows = channel.command_rows(f)
        powers = np.exp(-2j * np.pi * f * channel.hardware.dt_s)[:, None] ** np.arange(102)
        return tuple(
            _discs(f, (powers[:, : taps.size] @ taps)[:, None] * rows, np.zeros(f.size), 1 - ROOM)
            for _, taps in self._differences(channel.hardware)
        )

    def checks(self, loop: MeasuredLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        return tuple(
            Check(
                name=f"loop change by a delay of {other:g} frames",
                value=hinf_norm(through_taps(loop.parameter, taps)).upper,
                limit=1.0,
                method=_LEVEL_SETS,
            )
            for other, taps in self._differences(loop.hardware)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorUncertainty(Band):
    """Guaranteed stability for any unmodelled mirror dynamics below a relative size.

    The mirror's response is ``M (1 + delta)`` with ``|delta| <= relative`` in the band (and
    stable): the loop stays stable while ``relative |T| < 1`` there. Give one for each band.

    Parameters
    ----------
    relative : float
        Largest relative error of the response.
    low_hz, high_hz : float
        Ends of the band [Hz]; up to the Nyquist frequency for all that lies above.

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.MirrorUncertainty(relative=0.5, low_hz=150, high_hz=400).relative
    0.5
    """

    relative: float

    def __post_init__(self) -> None:
        Band.__post_init__(self)
        object.__setattr__(self, "relative", number(self.relative, "relative", above=0))

    @property
    def label(self) -> str:
        """What a message calls it."""
        return f"stability for mirror errors of {self.relative:g} in {self.band_text}"

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.within(self.low_hz, self.high_hz)
        rows = channel.complementary_rows(f)
        return (_discs(f, rows, np.zeros(f.size), (1 - ROOM) / self.relative),)

    def checks(self, loop: MeasuredLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        return (
            Check(
                name=f"|T| in {self.band_text} times the mirror's error",
                value=self.relative
                * band_norm(loop.complementary, self.low_hz, self.high_hz).upper,
                limit=1.0,
                method="level sets, all of the band",
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandRms:
    """Bound on the stroke or on the step of the commands, under turbulence and noise.

    Parameters
    ----------
    at_most_nm : float
        Standard deviation of u(k), or of ``u(k) - u(k-1)`` [nm].
    turbulence : Atmosphere, ARModel, TabulatedSpectrum or None
        Spectrum of the mode.
    noise_nm : float
        Measurement noise of the mode, per frame [nm].
    rate : bool, optional
        Bound the step from frame to frame instead of the stroke.

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> step = lbt.CommandRms(at_most_nm=30, turbulence=None, noise_nm=15.5, rate=True)
    >>> step.label
    'command step of at most 30 nm rms'
    """

    at_most_nm: float
    turbulence: Spectrum | None
    noise_nm: float
    rate: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "at_most_nm", number(self.at_most_nm, "at_most_nm", above=0))
        if not isinstance(self.rate, bool):
            raise ProblemError(f"rate must be True or False; got {self.rate!r}.")
        # the same disturbances as those of a variance
        disturbance = ResidualVariance(turbulence=self.turbulence, noise_nm=self.noise_nm)
        object.__setattr__(self, "noise_nm", disturbance.noise_nm)

    @property
    def label(self) -> str:
        """What a message calls it."""
        what = "step" if self.rate else "stroke"
        return f"command {what} of at most {self.at_most_nm:g} nm rms"

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints over the nodes of a grid."""
        f, w = grid.nodes_hz, grid.weights_hz
        density = self._density(f, channel.nyquist_hz, channel.hardware.dt_s)
        rows = np.sqrt(w * density)[:, None, None] * channel.command_rows(f)[:, None, :]
        function = Fractions(
            frequency_hz=f,
            rows=rows,
            centres=np.zeros((f.size, 1), np.complex128),
            steering=None,
            worst=False,
        )
        return (Bounded(function=function, limit=((1 - ROOM) * self.at_most_nm) ** 2),)

    def checks(self, loop: MeasuredLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        nyquist, dt_s = loop.hardware.frame_rate_hz / 2, loop.hardware.dt_s
        parameter = loop.parameter

        def power(f: FloatArray) -> FloatArray:
            response = np.abs(parameter.frequency_response(f)[:, 0, 0]) ** 2
            return np.asarray((response * self._density(f, nyquist, dt_s))[:, None, None])

        edges = [
            np.asarray(resonance_edges(loop.at(1.0))),
            spectrum_edges(self.turbulence, nyquist),
        ]
        edges_hz = np.unique(np.concatenate(edges))
        variance = float(adaptive_integral(power, edges_hz)[0, 0])
        return (
            Check(
                name=f"command {'step' if self.rate else 'stroke'} [nm rms]",
                value=float(np.sqrt(variance)),
                limit=self.at_most_nm,
                method="adaptive quadrature",
            ),
        )

    def _density(self, f: FloatArray, nyquist_hz: float, dt_s: float) -> FloatArray:
        """Spectrum of what drives Q, and of its steps where those are bounded [nm^2/Hz]."""
        density = np.full(f.size, self.noise_nm**2 / nyquist_hz)
        if self.turbulence is not None:
            density = density + self.turbulence.psd(f)
        return density * (4 * np.sin(np.pi * f * dt_s) ** 2 if self.rate else 1.0)


Demand: TypeAlias = (
    ModulusMargin
    | NoisePeak
    | Attenuation
    | SensorGainRange
    | DelayError
    | MirrorUncertainty
    | CommandRms
)
DEMANDS = (
    ModulusMargin, NoisePeak, Attenuation, SensorGainRange, DelayError, MirrorUncertainty,
    CommandRms,
)  # fmt: skip


def _discs(
    frequency_hz: FloatArray, rows: ComplexArray, centres: FloatArray, radii: FloatArray | float
) -> Discs:
    return Discs(
        frequency_hz=frequency_hz,
        rows=rows,
        centres=centres.astype(np.complex128),
        radii=np.broadcast_to(np.asarray(radii, dtype=np.float64), centres.shape),
    )
