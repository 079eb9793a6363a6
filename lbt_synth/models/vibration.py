"""Vibrations: damped resonances, sinusoids, and whether they fit a loop.

G. Agapito et al., 2008, equation 4, with the errata 1 and 7.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.resonance_spectrum import coefficient_rows
from lbt_synth.models.spectra import ARModel, variance_ratios
from lbt_synth.validation import (
    FloatArray,
    Positive,
    check_fields,
    choice,
    integer,
    number,
    real_array,
)

MOST_SECTIONS = 4  # of a bump: the coefficients of more in series lose too many digits
_MOST_LINES = 64  # that cover one vibration; each has two states
_UNIT = 1e-15  # rounding of a length of one


@dataclass(frozen=True, slots=True, kw_only=True)
class Vibration:
    """A narrow line, a damped resonance driven by white noise; or a bump, some in series.

    Parameters
    ----------
    frequency_hz : float
        Natural frequency [Hz].
    damping : float
        Damping ratio, above 0. From 1 on nothing oscillates: far above, it is a drift.
    rms_nm : float
        Standard deviation of the displacement along its direction [nm rms wavefront].
    direction : tuple of float, optional
        Direction over the modes, made a unit vector; ``(1, 0)`` shakes tip.
    sections : int, optional
        How many resonances of this frequency and damping stand in series, 1 to 4. The flanks of
        a bump of several are steeper than those of one that is as wide.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    >>> [round(float(a), 6) for a in line.ar_model(800).coefficients]
    [1.972279, -0.996863]
    """

    frequency_hz: Positive
    damping: Annotated[float, ("above", 0)]
    rms_nm: Positive
    direction: tuple[float, ...] = (1.0, 0.0)
    sections: int = 1

    def __post_init__(self) -> None:
        sections = integer(self.sections, "sections", at_least=1, at_most=MOST_SECTIONS)
        check_fields(self, direction=unit_direction(self.direction), sections=sections)

    def ar_model(self, frame_rate_hz: float) -> ARModel:
        """Return the AR process of this rms, of order 2 a section, sampled at a frame rate [Hz].

        A line that is not below the Nyquist frequency raises a ProblemError.
        """
        rate = number(frame_rate_hz, "frame_rate_hz", above=0)
        a, driving = sampled_lines(
            np.array(self.frequency_hz), np.array(self.damping), self.rms_nm, rate, self.sections
        )
        return ARModel(coefficients=a, driving_rms_nm=float(driving), frame_rate_hz=rate)

    def retuned(self, frequency_hz: float, *, frame_rate_hz: float, hold: str = "rms") -> Vibration:
        """Return this vibration at another frequency [Hz], for a loop of a frame rate [Hz].

        ``hold`` says what stays: the rms of the vibration, "rms", or that of its driving noise,
        "driving". A value out of its range raises a ProblemError.
        """
        choice(hold, "hold", ("rms", "driving"))
        moved = replace(self, frequency_hz=frequency_hz)
        if hold == "rms":
            return moved
        drive = self.ar_model(frame_rate_hz).driving_rms_nm
        ratio = drive / moved.ar_model(frame_rate_hz).driving_rms_nm
        return replace(moved, rms_nm=self.rms_nm * ratio)

    def at_frequency(self, frequency_hz: float) -> Vibration:
        """Return this vibration at another frequency [Hz], with the same rms and the same decay.

        The decay rate is damping times frequency, so the coefficient a2 of the AR2 process stays
        the same. A frequency that is not above the decay rate raises a ProblemError: nothing
        oscillates.
        """
        rate = self.damping * self.frequency_hz
        frequency = number(frequency_hz, "frequency_hz")
        if not frequency > rate:
            raise ProblemError(
                f"a vibration that decays at {rate:.6g} Hz (damping times frequency) must have a "
                f"frequency above that; got {frequency:.6g} Hz. Try a narrower range."
            )
        return replace(self, frequency_hz=frequency, damping=rate / frequency)


def unit_direction(direction: Any) -> tuple[float, ...]:
    """Return a direction over the modes as a vector of length one."""
    vector = np.atleast_1d(real_array(direction, "direction"))
    length = float(np.linalg.norm(vector))
    if vector.ndim != 1 or length == 0:
        raise ProblemError(
            f"direction must be a vector over the modes, not zero; got {direction!r}."
        )
    if abs(length - 1) > _UNIT:  # what has been scaled stays as it is, to the last bit
        vector = vector / length
    return tuple(float(v) for v in vector)


def require_below_nyquist(frequency_hz: float, frame_rate_hz: float) -> None:
    """Refuse a vibration that a frame rate does not sample."""
    if not frequency_hz < frame_rate_hz / 2:
        raise ProblemError(
            f"a vibration must lie below the Nyquist frequency {frame_rate_hz / 2:.6g} Hz; "
            f"got {frequency_hz:.6g} Hz. Give the frequency it is aliased to."
        )


def sampled_lines(
    frequency_hz: FloatArray,
    damping: FloatArray,
    rms_nm: FloatArray | float,
    frame_rate_hz: float,
    sections: int = 1,
) -> tuple[FloatArray, FloatArray]:
    """Coefficients (p, 2 m) and driving noise (p,) [nm] of p vibrations of m sections."""
    require_below_nyquist(float(np.max(frequency_hz, initial=0.0)), frame_rate_hz)
    a = coefficient_rows(2 * np.pi * frequency_hz / frame_rate_hz, damping)
    if sections > 1:
        a = _series_coefficients(a, sections)
    # by the rounded coefficients, so that the process has exactly this rms
    return a, np.asarray(rms_nm / np.sqrt(variance_ratios(a)))


def _series_coefficients(one: FloatArray, sections: int) -> FloatArray:
    """Coefficients (..., 2 m) of m sections in series, each of coefficients (..., 2)."""
    factor = np.concatenate([np.ones_like(one[..., :1]), -one], axis=-1)
    product = factor
    for _ in range(sections - 1):
        longer = np.zeros((*product.shape[:-1], product.shape[-1] + 2))
        for lag in range(3):
            longer[..., lag : lag + product.shape[-1]] += factor[..., lag : lag + 1] * product
        product = longer
    return -product[..., 1:]


def spread_lines(
    line: Vibration, half_width_hz: float, lines: int, *, name: str = "half_width_hz"
) -> list[Vibration]:
    """Split a vibration into lines at the mid-points of equal parts of an interval.

    They have its direction and decay rate, and together its variance.
    """
    half = number(
        half_width_hz,
        name,
        above=0,
        below=line.frequency_hz,
        hint="All frequencies must stay above 0 Hz.",
    )
    count = integer(lines, "lines", at_least=1, at_most=_MOST_LINES)
    places = line.frequency_hz + half * ((2 * np.arange(count) + 1) / count - 1)
    rms_nm = line.rms_nm / float(np.sqrt(count))
    return [replace(line.at_frequency(f), rms_nm=rms_nm) for f in places.tolist()]


@dataclass(frozen=True, slots=True, kw_only=True)
class SinusoidalVibration:
    """A vibration that is a pure sinusoid; its frequency may drift linearly in time.

    The phase of one that drifts is the integral of its frequency. Only simulations accept it;
    whatever needs a stationary truth refuses it.

    Parameters
    ----------
    frequency_hz : float
        Frequency [Hz]; of one that drifts that up to time 0.
    rms_nm : float
        Standard deviation, amplitude / sqrt(2), along its direction [nm rms wavefront].
    direction : tuple of float, optional
        Direction over the modes, made a unit vector; ``(1, 0)`` shakes tip.
    end_hz, duration_s : float, optional
        Frequency at which a drift arrives, and where it stays [Hz]; duration of the drift [s].

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range, or a drift has no end or no duration.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=797).amplitude_nm, 1)
    1127.1
    >>> line = lbt.models.SinusoidalVibration(frequency_hz=17, end_hz=23, duration_s=60, rms_nm=797)
    >>> line.frequency_hz_at([-5, 0, 30, 60, 100]).tolist()
    [17.0, 17.0, 20.0, 23.0, 23.0]
    """

    frequency_hz: Positive
    rms_nm: Positive
    direction: tuple[float, ...] = (1.0, 0.0)
    end_hz: Positive | None = None
    duration_s: Positive | None = None

    def __post_init__(self) -> None:
        check_fields(self, direction=unit_direction(self.direction))
        if (self.end_hz is None) != (self.duration_s is None):
            raise ProblemError("a drift needs end_hz and duration_s; got one of them.")

    @property
    def drifts(self) -> bool:
        """Whether its frequency moves."""
        return self.end_hz is not None

    @property
    def amplitude_nm(self) -> float:
        """Peak displacement [nm rms wavefront]."""
        return float(np.sqrt(2) * self.rms_nm)

    def frequency_hz_at(self, time_s: ArrayLike) -> FloatArray:
        """Return the frequency [Hz] at finite times [s]; a drift begins at time 0."""
        t, end_hz = real_array(time_s, "time_s"), self.end_hz or self.frequency_hz
        moved = np.clip(t / (self.duration_s or 1.0), 0.0, 1.0)
        return np.asarray(self.frequency_hz + (end_hz - self.frequency_hz) * moved)

    def turns_at(self, time_s: ArrayLike) -> FloatArray:
        """Return the phase over 2 pi at finite times [s]: the frequency's integral from time 0."""
        t, duration_s = real_array(time_s, "time_s"), self.duration_s or 1.0
        end_hz = self.end_hz or self.frequency_hz
        inside, arrived = np.clip(t, 0.0, duration_s), np.maximum(t - duration_s, 0.0)
        rise = (end_hz - self.frequency_hz) / duration_s
        before = self.frequency_hz * (t - arrived)
        return np.asarray(before + rise * inside**2 / 2 + end_hz * arrived)


TrueVibration: TypeAlias = Vibration | SinusoidalVibration


def checked_direction(vibration: TrueVibration, hardware: LoopHardware) -> FloatArray:
    """Return the direction (n,) of a vibration, which must fit the loop."""
    frequency_hz = max(vibration.frequency_hz, getattr(vibration, "end_hz", None) or 0.0)
    if len(vibration.direction) != hardware.modes:
        raise DimensionError(
            f"the direction of a vibration must have {hardware.modes} components, one per mode; "
            f"got {len(vibration.direction)} at {frequency_hz:.6g} Hz."
        )
    require_below_nyquist(frequency_hz, hardware.frame_rate_hz)
    return np.array(vibration.direction)


def stationary_vibrations(vibrations: Iterable[TrueVibration]) -> tuple[TrueVibration, ...]:
    """Return the vibrations; refuse one that drifts."""
    lines = tuple(vibrations)
    for line in lines:
        if isinstance(line, SinusoidalVibration) and line.drifts:
            raise ProblemError(
                "this needs a truth that is stationary; got a vibration that drifts from "
                f"{line.frequency_hz:.6g} to {line.end_hz:.6g} Hz. Simulate it, or take "
                "vibrations that stay, at the frequencies in question."
            )
    return lines
