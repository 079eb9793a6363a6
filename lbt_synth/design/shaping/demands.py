"""Demands on the closed loop: bounds, and stability where gain, delay or mirror are uncertain.

Each demand gives convex constraints at given frequencies, slightly tightened, and checks of
the real loop over all frequencies, which know nothing of the programme.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from lbt_synth.design.certificate import Check
from lbt_synth.design.shaping.channel import Channel, SingleModeLoop
from lbt_synth.design.shaping.frequencies import ROOM, Grid, band_text, discs, spectrum_edges
from lbt_synth.design.shaping.terms import ResidualVariance
from lbt_synth.errors import ProblemError
from lbt_synth.linear import hinf_norm
from lbt_synth.linear.convex_functions import Constraint, Fractions, FunctionBound, HalfPlanes
from lbt_synth.linear.norms import band_norm, largest_real_part
from lbt_synth.linear.quadrature import adaptive_integral
from lbt_synth.loop.budget import resonance_edges
from lbt_synth.loop.stable_range import CIRCLE_LIMIT, LoopChange, append_taps, loop_changes
from lbt_synth.models import LoopHardware, Spectrum
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import (
    FloatArray,
    NotNegative,
    Positive,
    check_fields,
    choice,
    number,
    set_fields,
)

LEVEL_SETS = "level sets, all frequencies"
_REJECTION = "rejection"
_RESPONSES = {
    _REJECTION: "rejection",
    "noise": "amplification of noise",
    "complementary": "complementary sensitivity",
}
_HOLDS_ONE = "The range must hold 1, the gain that is designed for; set model.sensor_gain."


@dataclass(frozen=True, slots=True, kw_only=True)
class Bound:
    """Bound on a response of the loop, over a band or at all frequencies.

    A modulus margin m is a bound of 1 / m on the rejection at all frequencies. Stability for every
    unmodelled relative error of the mirror's response below r is a bound of 1 / r on T.

    Parameters
    ----------
    response : {"rejection", "noise", "complementary"}
        The residual of a unit disturbance, ``S``; that of a unit of measurement noise; or the
        complementary sensitivity ``T``.
    at_most : float
        Largest modulus of the response.
    low_hz, high_hz : float, optional
        Ends of a band [Hz]; all frequencies without ``high_hz``.
    sensor_gain : float, optional
        Sensor gain at which a rejection is bounded; the other two are at 1.

    Raises
    ------
    ProblemError
        If a value is out of its range, or the bound is too loose to be convex at this gain.

    Notes
    -----
    The rejection is exact at any sensor gain g: ``|1 - T| <= a |1 - (1 - g) T|`` is a disc of T for
    ``a |1 - g| < 1``.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.design.shaping.Bound(response="rejection", low_hz=0, high_hz=2, at_most=0.01).label
    'rejection of at most 0.01 in 0-2 Hz at sensor gain 1'
    """

    response: str
    at_most: Positive
    low_hz: NotNegative = 0.0
    high_hz: float | None = None
    sensor_gain: Positive = 1.0

    def __post_init__(self) -> None:
        choice(self.response, "response", tuple(_RESPONSES))
        check_fields(self)
        if self.high_hz is not None:
            set_fields(self, high_hz=number(self.high_hz, "high_hz", above=self.low_hz))
        rest = abs(1 - self.sensor_gain)
        if rest and self.response != _REJECTION:
            raise ProblemError(
                f"a bound on {self.response} is at sensor gain 1; got {self.sensor_gain:g}."
            )
        if not self.at_most * rest < 1:
            raise ProblemError(
                f"at_most must be below {1 / rest:.6g} at sensor gain {self.sensor_gain:g}, where "
                f"it is no convex bound; got {self.at_most:g}."
            )

    @property
    def label(self) -> str:
        """What tables and messages call it."""
        words = f"{_RESPONSES[self.response]} of at most {self.at_most:.4g}"
        if self.high_hz is not None:
            words += f" in {band_text(self.low_hz, self.high_hz)}"
        elif self.response == _REJECTION and self.sensor_gain == 1:
            return f"modulus margin of at least {1 / self.at_most:.4g}"
        return words + f" at sensor gain {self.sensor_gain:g}" * (self.response == _REJECTION)

    def constraints(self, channel: Channel, grid: Grid) -> tuple[Constraint, ...]:
        """Return the convex constraints at the points of a grid."""
        f = grid.points_hz if self.high_hz is None else grid.within(self.low_hz, self.high_hz)
        if self.response != _REJECTION:
            noise = self.response == "noise"
            rows = channel.noise_rows(f) if noise else channel.complementary_rows(f)
            return (discs(f, rows, 0.0, (1 - ROOM) * self.at_most),)
        rest = 1 - self.sensor_gain
        # near the edge of convexity a small part of the disc's radius is a large one of the bound
        stretch = (1 + self.at_most * abs(rest)) / (1 - self.at_most * abs(rest))
        a = (1 - min(ROOM * stretch, 0.05)) * self.at_most
        curvature = 1 - (a * rest) ** 2
        centre = (1 - a**2 * rest) / curvature
        radius = a * self.sensor_gain / curvature
        return (discs(f, -channel.complementary_rows(f), centre, radius),)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop, by level sets."""
        closed, name = loop.at(self.sensor_gain), f"peak of the {self.response}"
        sources = {"rejection": "phase", "noise": "noise"}
        source = sources.get(self.response)
        system = closed.path(source, "residual") if source else loop.complementary()
        if self.high_hz is None:
            peak = hinf_norm(system).upper
        else:
            name += f" in {band_text(self.low_hz, self.high_hz)}"
            peak = band_norm(system, self.low_hz, self.high_hz).upper
        name += f" at sensor gain {self.sensor_gain:g}" * (self.response == _REJECTION)
        return (Check(name, peak, self.at_most, LEVEL_SETS),)


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
    >>> step = lbt.design.shaping.CommandRms(
    ...     at_most_nm=30, turbulence=None, noise_nm=15.5, rate=True
    ... )
    >>> step.label
    'command step of at most 30 nm rms'
    """

    at_most_nm: Positive
    turbulence: Spectrum | None
    noise_nm: float
    rate: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        if not isinstance(self.rate, bool):
            raise ProblemError(f"rate must be True or False; got {self.rate!r}.")
        # the same disturbances as those of a variance
        disturbance = ResidualVariance(turbulence=self.turbulence, noise_nm=self.noise_nm)
        set_fields(self, noise_nm=disturbance.noise_nm)

    @property
    def label(self) -> str:
        """What tables and messages call it."""
        return f"command {self._what} of at most {nm_text(self.at_most_nm, 'g', unit='nm rms')}"

    @property
    def _what(self) -> str:
        return "step" if self.rate else "stroke"

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

    def _density(self, f: FloatArray, nyquist_hz: float, dt_s: float) -> FloatArray:
        """Spectrum of what drives Q, and of its steps where those are bounded [nm^2/Hz]."""
        density = np.full(f.size, self.noise_nm**2 / nyquist_hz)
        if self.turbulence is not None:
            density = density + self.turbulence.psd(f)
        return density * (4 * np.sin(np.pi * f * dt_s) ** 2 if self.rate else 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopErrors:
    """Guaranteed stability for every sensor gain of an interval and every delay error, together.

    The gain stays, or moves at any speed while the delay is right.

    With the mirror's response ``M_d`` at a delay d, the loop is stable at the gain g and the delay
    ``d + e`` while ``1 + z^-1 (g M_(d+e) - M_d) Q`` does not vanish: its real part is kept above
    zero, which is convex. Delays, fractions included, are those of :class:`LoopHardware`, whose
    response is piecewise linear in e; so the ends of both intervals and the whole delays between
    stand for all loops. A delay below one frame does not occur.

    For a gain that moves, with ``a = high - 1`` and ``b = 1 - low``, one Lyapunov function for all
    gains exists if and only if ``|T - (a - b) / (2 a b)| < (a + b) / (2 a b)`` at all frequencies
    (the circle criterion): convex in T, so nothing is lost. At an end of 1 the disc is the
    half-plane of a gain that stays.

    Parameters
    ----------
    low, high : float, optional
        Ends of the interval of gains, around 1 (the gain that is designed for).
    delay_frames : float, optional
        Largest error of the delay, late or early [frames], at most 1.
    moving : bool, optional
        Whether the gain may move in its interval, at any speed.

    Raises
    ------
    ProblemError
        If the interval does not hold 1, or is not positive, nothing is uncertain, or a gain moves
        without an interval; in a design with an error of the delay, if the mirror has dynamics.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.design.shaping.LoopErrors(low=0.25, high=1.3, delay_frames=0.1).label
    'stability for sensor gains 0.25 to 1.3 and delay errors up to 0.1 frames'
    """

    low: Annotated[float, ("above", 0), ("at_most", 1), ("hint", _HOLDS_ONE)] = 1.0
    high: Annotated[float, ("at_least", 1), ("hint", _HOLDS_ONE)] = 1.0
    delay_frames: Annotated[float, ("at_least", 0), ("at_most", 1)] = 0.0
    moving: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        if self.low == self.high and (self.moving or not self.delay_frames):
            raise ProblemError(
                "loop errors need an interval of gains, in which a gain may move, or an error of "
                "the delay; got neither."
            )

    @property
    def label(self) -> str:
        """What is demanded, in words."""
        kind = "moving sensor gains" if self.moving else "sensor gains"
        gains = f"{kind} {self.low:g} to {self.high:g}" * (self.low < self.high)
        late = f"delay errors up to {self.delay_frames:g} frames" * (self.delay_frames > 0)
        return f"stability for {' and '.join(text for text in (gains, late) if text)}"

    @property
    def _disc(self) -> tuple[float, float] | None:
        """Centre and radius of the disc for T of a gain that moves to both sides, else None."""
        a, b = self.high - 1, 1 - self.low
        if not (self.moving and a > 0 and b > 0):
            return None
        return (a - b) / (2 * a * b), (a + b) / (2 * a * b)

    def _changes(self, hardware: LoopHardware) -> list[LoopChange]:
        """Return the loops that stand for all whose gain and delay stay."""
        if self._disc is not None and not self.delay_frames:
            return []
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
        rows, bounds = channel.command_rows(f), np.full(f.size, 1 - ROOM)
        turns = np.exp(-2j * np.pi * f * channel.hardware.dt_s)[:, None]
        constraints: list[Constraint] = []
        for *_, taps in self._changes(channel.hardware):
            response = (turns ** np.arange(taps.size) @ taps)[:, None] * rows
            constraints.append(HalfPlanes(frequency_hz=f, rows=response.real, bounds=bounds))
        if self._disc is not None:
            centre, radius = self._disc
            rows = channel.complementary_rows(f)
            constraints.append(discs(f, rows, -centre, (1 - ROOM) * radius))
        return tuple(constraints)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check the real loop, over all frequencies."""
        checks = [
            Check(
                f"loop change by a sensor gain of {gain:g} and a delay of {delay_frames:g} frames",
                largest_real_part(append_taps(loop.parameter, taps)),
                1.0,
                LEVEL_SETS,
            )
            for gain, delay_frames, taps in self._changes(loop.hardware)
        ]
        if self.moving:
            middle, value = (self.low + self.high) / 2, np.inf
            if loop.at(middle).is_stable:
                peak = hinf_norm(loop.complementary(middle)).upper
                value = (self.high - self.low) / (2 * middle) * peak
            name = f"circle criterion of a moving gain, {self.low:g} to {self.high:g}"
            checks.append(Check(name, value, CIRCLE_LIMIT, LEVEL_SETS))
        return tuple(checks)


Demand: TypeAlias = Bound | CommandRms | LoopErrors
