"""Demands that the loop stays stable where sensor gain, delay or mirror are uncertain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, TypeAlias

import numpy as np
from numpy.polynomial.polynomial import polysub

from lbt_synth.design.certificate import Check
from lbt_synth.design.shaping.channel import Channel, SingleModeLoop, append_taps
from lbt_synth.design.shaping.frequencies import LEVEL_SETS, ROOM, Band, CheckedFields, Grid, discs
from lbt_synth.errors import ProblemError
from lbt_synth.linear import hinf_norm
from lbt_synth.linear.convex_functions import Constraint, HalfPlanes
from lbt_synth.linear.norms import largest_real_part
from lbt_synth.loop.moving_gain import CIRCLE_LIMIT, circle_norm
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import instant_mirror
from lbt_synth.validation import FloatArray, Positive

_HOLDS_ONE = "The range must hold 1, the gain that is designed for; set model.sensor_gain."


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorGainRange(CheckedFields):
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
    >>> lbt.design.shaping.SensorGainRange(low=0.25, high=1.3).label
    'stability for sensor gains 0.25 to 1.3'
    """

    _label: ClassVar = "stability for sensor gains {0.low:g} to {0.high:g}"
    low: Annotated[float, ("above", 0), ("at_most", 1), ("hint", _HOLDS_ONE)]
    high: Annotated[float, ("at_least", 1), ("hint", _HOLDS_ONE)]

    def _bounds(self) -> tuple[tuple[float, float], ...]:
        """Return signs and bounds of the real part of T."""
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

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        T, checks = loop.complementary, []
        for sign, bound in self._bounds():
            which = "largest" if sign > 0 else "least, negated"
            peak = largest_real_part(replace(T, C=sign * T.C, D=sign * T.D))
            name = f"real part of the complementary sensitivity, {which}"
            checks.append(Check(name, peak, bound, LEVEL_SETS))
        return tuple(checks)


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingSensorGain(SensorGainRange):
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

    def _disc(self) -> tuple[float, float] | None:
        """Return centre and radius of the disc for T; None for a half-plane."""
        a, b = self.high - 1, 1 - self.low
        return ((a - b) / (2 * a * b), (a + b) / (2 * a * b)) if a > 0 and b > 0 else None

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        disc, f = self._disc(), grid.points_hz
        if disc is None:
            return SensorGainRange.constraints(self, channel, grid)
        return (discs(f, channel.complementary_rows(f), -disc[0], (1 - ROOM) * disc[1]),)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop by the norm at the middle of the interval."""
        value = circle_norm(loop.at(1.0), low=self.low, high=self.high)
        name = f"circle criterion of a moving gain, {self.low:g} to {self.high:g}"
        return (Check(name, value, CIRCLE_LIMIT, LEVEL_SETS),)


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayError(CheckedFields):
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
        If it is out of its range; in a design, if the mirror has dynamics.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.design.shaping.DelayError(frames=0.25).frames
    0.25
    """

    _label: ClassVar = "stability for delay errors up to {0.frames:g} frames"
    frames: Annotated[float, ("above", 0), ("at_most", 1)]

    def _differences(self, hardware: LoopHardware) -> list[tuple[float, FloatArray]]:
        """Return the delays that stand for all of them, each with the taps of ``M_(d+e) - M_d``."""
        if hardware.mirror is not None:
            raise ProblemError(
                "a bound for all delay errors needs a mirror that settles at once, whose response "
                "is piecewise linear in the delay; got one with dynamics. Try MirrorUncertainty, "
                "or a design for mirror=None and its map at delay errors."
            )
        d = hardware.delay_frames
        low, high = max(d - self.frames, 1.0), d + self.frames
        whole = np.arange(np.ceil(low), np.floor(high) + 1)
        others = [float(other) for other in np.setdiff1d([low, high, *whole], d)]
        there = [instant_mirror(other).taps for other in others]
        taps = [polysub(one, hardware.mirror_taps).astype(np.float64) for one in there]
        return list(zip(others, taps, strict=True))

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz
        rows = channel.command_rows(f)
        powers = np.exp(-2j * np.pi * f * channel.hardware.dt_s)[:, None] ** np.arange(102)
        return tuple(
            discs(f, (powers[:, : taps.size] @ taps)[:, None] * rows, 0.0, 1 - ROOM)
            for _, taps in self._differences(channel.hardware)
        )

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop."""
        checks = []
        for other, taps in self._differences(loop.hardware):
            change = hinf_norm(append_taps(loop.parameter, taps)).upper
            name = f"loop change by a delay of {other:g} frames"
            checks.append(Check(name, change, 1.0, LEVEL_SETS))
        return tuple(checks)


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


Uncertainty: TypeAlias = SensorGainRange | MovingSensorGain | DelayError | MirrorUncertainty
