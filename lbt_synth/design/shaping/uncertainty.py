"""Demands that the loop stays stable where sensor gain, delay or mirror are uncertain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, TypeAlias

import numpy as np

from lbt_synth.design.certificate import Check
from lbt_synth.design.shaping.channel import Channel, SingleModeLoop
from lbt_synth.design.shaping.frequencies import LEVEL_SETS, ROOM, Band, CheckedFields, Grid, discs
from lbt_synth.errors import ProblemError
from lbt_synth.linear.convex_functions import Constraint, HalfPlanes
from lbt_synth.linear.norms import largest_real_part
from lbt_synth.loop.stable_range import (
    CIRCLE_LIMIT,
    LoopChange,
    append_taps,
    circle_norm,
    loop_changes,
)
from lbt_synth.models import LoopHardware
from lbt_synth.validation import Positive

_HOLDS_ONE = "The range must hold 1, the gain that is designed for; set model.sensor_gain."


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


Uncertainty: TypeAlias = LoopErrors | MovingSensorGain | MirrorUncertainty
