"""Demands on the closed loop: bounds, and stability where gain, delay or mirror are uncertain.

Each demand gives convex constraints at given frequencies, slightly tightened, and checks of
the real loop over all frequencies, which know nothing of the programme.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, TypeAlias

import numpy as np

from lbt_synth.design.certificate import Check
from lbt_synth.design.shaping.channel import Channel, SingleModeLoop
from lbt_synth.design.shaping.frequencies import (
    LEVEL_SETS,
    ROOM,
    Band,
    CheckedFields,
    Grid,
    discs,
    spectrum_edges,
)
from lbt_synth.design.shaping.objectives import ResidualVariance
from lbt_synth.errors import ProblemError
from lbt_synth.linear import hinf_norm
from lbt_synth.linear.convex_functions import Constraint, Fractions, FunctionBound, HalfPlanes
from lbt_synth.linear.norms import largest_real_part
from lbt_synth.linear.quadrature import adaptive_integral
from lbt_synth.loop.budget import resonance_edges
from lbt_synth.loop.stable_range import (
    CIRCLE_LIMIT,
    LoopChange,
    append_taps,
    circle_norm,
    loop_changes,
)
from lbt_synth.models import LoopHardware, Spectrum
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import FloatArray, Positive, set_fields

_HOLDS_ONE = "The range must hold 1, the gain that is designed for; set model.sensor_gain."


@dataclass(frozen=True, slots=True, kw_only=True)
class ModulusMargin(CheckedFields):
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
    >>> lbt.design.shaping.ModulusMargin(at_least=0.45).label
    'modulus margin of at least 0.45'
    """

    _label: ClassVar = "modulus margin of at least {0.at_least:g}"
    at_least: Annotated[float, ("above", 0), ("below", 1)]

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz
        return (discs(f, -channel.complementary_rows(f), 1.0, (1 - ROOM) / self.at_least),)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        peak = hinf_norm(loop.sensitivity).upper
        return (Check("peak of the sensitivity", peak, 1 / self.at_least, LEVEL_SETS),)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisePeak(CheckedFields):
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
    >>> lbt.design.shaping.NoisePeak(at_most=2).at_most
    2.0
    """

    _label: ClassVar = "noise amplified by at most {0.at_most:g}"
    at_most: Positive

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz
        return (discs(f, channel.noise_rows(f), 0.0, (1 - ROOM) * self.at_most),)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        peak = hinf_norm(loop.at(1.0).path("noise", "residual")).upper
        return (Check("peak of the noise transfer", peak, self.at_most, LEVEL_SETS),)


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
    >>> lbt.design.shaping.Attenuation(low_hz=0, high_hz=2, at_most=0.01).label
    'attenuation to 0.01 in 0-2 Hz at sensor gain 1'
    """

    _label: ClassVar = (
        "attenuation to {0.at_most:g} in {0.band_text} at sensor gain {0.sensor_gain:g}"
    )
    at_most: Positive
    sensor_gain: Positive = 1.0

    def __post_init__(self) -> None:
        Band.__post_init__(self)
        if not self.at_most * abs(1 - self.sensor_gain) < 1:
            raise ProblemError(
                f"at_most must be below {1 / abs(1 - self.sensor_gain):.6g} at sensor gain "
                f"{self.sensor_gain:g}, where it is no convex bound; got {self.at_most:g}."
            )

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.within(self.low_hz, self.high_hz)
        rest = 1 - self.sensor_gain
        # near the edge of convexity a small part of the disc's radius is a large one of the bound
        stretch = (1 + self.at_most * abs(rest)) / (1 - self.at_most * abs(rest))
        a = (1 - min(ROOM * stretch, 0.05)) * self.at_most
        curvature = 1 - (a * rest) ** 2
        centre = (1 - a**2 * rest) / curvature
        radius = a * self.sensor_gain / curvature
        return (discs(f, -channel.complementary_rows(f), centre, radius),)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        name = f"rejection in {self.band_text} at sensor gain {self.sensor_gain:g}"
        peak = self.peak(loop.at(self.sensor_gain).path("phase", "residual"))
        return (self.check(name, peak, self.at_most),)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandRms(CheckedFields):
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
    >>> step = lbt.design.shaping.CommandRms(
    ...     at_most_nm=30, turbulence=None, noise_nm=15.5, rate=True
    ... )
    >>> step.label
    'command step of at most 30 nm rms'
    """

    _label: ClassVar = "command {0._what} of at most {0._shown_limit}"
    at_most_nm: Positive
    turbulence: Spectrum | None
    noise_nm: float
    rate: bool = False

    def __post_init__(self) -> None:
        CheckedFields.__post_init__(self)
        if not isinstance(self.rate, bool):
            raise ProblemError(f"rate must be True or False; got {self.rate!r}.")
        # the same disturbances as those of a variance
        disturbance = ResidualVariance(turbulence=self.turbulence, noise_nm=self.noise_nm)
        set_fields(self, noise_nm=disturbance.noise_nm)

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints over the nodes of a grid."""
        f, w = grid.nodes_hz, grid.weights_hz
        density = self._density(f, channel.nyquist_hz, channel.hardware.dt_s)
        rows = np.sqrt(w * density)[:, None, None] * channel.command_rows(f)[:, None, :]
        centres = np.zeros((f.size, 1), np.complex128)
        function = Fractions(frequency_hz=f, rows=rows, centres=centres, steering=None, worst=False)
        return (FunctionBound(function=function, limit=((1 - ROOM) * self.at_most_nm) ** 2),)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        nyquist, dt_s = loop.hardware.frame_rate_hz / 2, loop.hardware.dt_s
        parameter = loop.parameter

        def power(f: FloatArray) -> FloatArray:
            response = np.abs(parameter.frequency_response(f)[:, 0, 0]) ** 2
            return np.asarray((response * self._density(f, nyquist, dt_s))[:, None, None])

        edges = [resonance_edges(loop.at(1.0)), spectrum_edges(self.turbulence, nyquist)]
        variance = adaptive_integral(power, np.unique(np.concatenate(edges)))[0, 0]
        share = float(np.sqrt(variance)) / self.at_most_nm
        name = f"rms of the command {self._what} over its bound"
        return (Check(name, share, 1.0, "adaptive quadrature"),)

    @property
    def _shown_limit(self) -> str:
        return nm_text(self.at_most_nm, "g", unit="nm rms")

    @property
    def _what(self) -> str:
        return "step" if self.rate else "stroke"

    def _density(self, f: FloatArray, nyquist_hz: float, dt_s: float) -> FloatArray:
        """Spectrum of what drives Q, and of its steps where those are bounded [nm^2/Hz]."""
        density = np.full(f.size, self.noise_nm**2 / nyquist_hz)
        if self.turbulence is not None:
            density = density + self.turbulence.psd(f)
        return density * (4 * np.sin(np.pi * f * dt_s) ** 2 if self.rate else 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopErrors(CheckedFields):
    """Guaranteed stability for every sensor gain of an interval and every delay error, together.

    With the mirror's response ``M_d`` at a delay d, the loop is stable at the gain g and the delay
    ``d + e`` while ``1 + z^-1 (g M_(d+e) - M_d) Q`` does not vanish: its real part is kept above
    zero, which is convex. Delays, fractions included, are those of :class:`LoopHardware`, whose
    response is piecewise linear in e; so the ends of both intervals and the whole delays between
    stand for all loops. A delay below one frame does not occur.

    Parameters
    ----------
    low, high : float, optional
        Ends of the interval of gains, around 1 (the gain that is designed for).
    delay_frames : float, optional
        Largest error of the delay, late or early [frames], at most 1.

    Raises
    ------
    ProblemError
        If the interval does not hold 1, or is not positive, or nothing is uncertain; in a design
        with an error of the delay, if the mirror has dynamics.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.design.shaping.LoopErrors(low=0.25, high=1.3, delay_frames=0.1).label
    'stability for sensor gains 0.25 to 1.3 and delay errors up to 0.1 frames'
    """

    low: Annotated[float, ("above", 0), ("at_most", 1), ("hint", _HOLDS_ONE)] = 1.0
    high: Annotated[float, ("at_least", 1), ("hint", _HOLDS_ONE)] = 1.0
    delay_frames: Annotated[float, ("at_least", 0), ("at_most", 1)] = 0.0

    def __post_init__(self) -> None:
        CheckedFields.__post_init__(self)
        if self.low == self.high and not self.delay_frames:
            raise ProblemError(
                "loop errors need an interval of gains, or an error of the delay; got neither."
            )

    @property
    def label(self) -> str:
        """What is demanded, in words."""
        gains = f"sensor gains {self.low:g} to {self.high:g}" * (self.low < self.high)
        late = f"delay errors up to {self.delay_frames:g} frames" * (self.delay_frames > 0)
        return f"stability for {' and '.join(text for text in (gains, late) if text)}"

    def _changes(self, hardware: LoopHardware) -> list[LoopChange]:
        """Return the loops that stand for all."""
        if self.delay_frames and hardware.mirror is not None:
            raise ProblemError(
                "a bound for all delay errors needs a mirror that settles at once, whose response "
                "is piecewise linear in the delay; got one with dynamics. Try MirrorUncertainty, "
                "or a design for mirror=None and its map at delay errors."
            )
        return loop_changes(hardware, low=self.low, high=self.high, delay_frames=self.delay_frames)

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz
        rows = channel.command_rows(f)
        changes = [taps for *_, taps in self._changes(channel.hardware)]
        turns = np.exp(-2j * np.pi * f * channel.hardware.dt_s)[:, None]
        powers = turns ** np.arange(max(taps.size for taps in changes))
        bounds = np.full(f.size, 1 - ROOM)
        responses = ((powers[:, : taps.size] @ taps)[:, None] * rows for taps in changes)
        return tuple(
            HalfPlanes(frequency_hz=f, rows=response.real, bounds=bounds) for response in responses
        )

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop, over all frequencies."""
        return tuple(
            Check(
                f"loop change by a sensor gain of {gain:g} and a delay of {delay_frames:g} frames",
                largest_real_part(append_taps(loop.parameter, taps)),
                1.0,
                LEVEL_SETS,
            )
            for gain, delay_frames, taps in self._changes(loop.hardware)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingSensorGain(CheckedFields):
    """Guaranteed stability for a sensor gain that moves in an interval, at any speed.

    With ``a = high - 1`` and ``b = 1 - low``, one Lyapunov function for all gains exists if and
    only if ``|T - (a - b) / (2 a b)| < (a + b) / (2 a b)`` at all frequencies (the circle
    criterion): convex in T, so nothing is lost. At an end of 1 the disc is a half-plane.

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
    >>> lbt.design.shaping.MovingSensorGain(low=0.25, high=1.3).label
    'stability while the sensor gain moves in 0.25 to 1.3'
    """

    _label: ClassVar = "stability while the sensor gain moves in {0.low:g} to {0.high:g}"

    low: Annotated[float, ("above", 0), ("at_most", 1), ("hint", _HOLDS_ONE)]
    high: Annotated[float, ("at_least", 1), ("hint", _HOLDS_ONE)]

    def _disc(self) -> tuple[float, float] | None:
        """Return centre and radius of the disc for T; None for a half-plane."""
        a, b = self.high - 1, 1 - self.low
        return ((a - b) / (2 * a * b), (a + b) / (2 * a * b)) if a > 0 and b > 0 else None

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        disc, f = self._disc(), grid.points_hz
        if disc is None:
            return LoopErrors(low=self.low, high=self.high).constraints(channel, grid)
        return (discs(f, channel.complementary_rows(f), -disc[0], (1 - ROOM) * disc[1]),)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop by the norm at the middle of the interval."""
        value = circle_norm(loop.at(1.0), low=self.low, high=self.high)
        name = f"circle criterion of a moving gain, {self.low:g} to {self.high:g}"
        return (Check(name, value, CIRCLE_LIMIT, LEVEL_SETS),)


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
    >>> lbt.design.shaping.MirrorUncertainty(relative=0.5, low_hz=150, high_hz=400).relative
    0.5
    """

    _label: ClassVar = "stability for mirror errors of {0.relative:g} in {0.band_text}"
    relative: Positive

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.within(self.low_hz, self.high_hz)
        return (discs(f, channel.complementary_rows(f), 0.0, (1 - ROOM) / self.relative),)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        name = f"|T| in {self.band_text} times the mirror's error"
        return (self.check(name, self.relative * self.peak(loop.complementary), 1.0),)


Demand: TypeAlias = (
    ModulusMargin
    | NoisePeak
    | Attenuation
    | CommandRms
    | LoopErrors
    | MovingSensorGain
    | MirrorUncertainty
)
