"""A vibration that is a damped resonance (Agapito et al. 2008, eq. 4, errata 1 and 7)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.models.ar_model import ARModel, variance_ratios
from lbt_synth.models.resonance_spectrum import coefficient_rows
from lbt_synth.validation import FloatArray, Positive, check_fields, choice, number, real_array


@dataclass(frozen=True, slots=True, kw_only=True)
class Vibration:
    """A narrow line: a damped resonance driven by white noise.

    Parameters
    ----------
    frequency_hz : float
        Natural frequency [Hz].
    damping : float
        Damping ratio, in (0, 1).
    rms_nm : float
        Standard deviation of the displacement along its direction [nm rms wavefront].
    direction : tuple of float, optional
        Direction over the modes, made a unit vector; ``(1, 0)`` shakes tip.

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
    damping: Annotated[float, ("above", 0), ("below", 1)]
    rms_nm: Positive
    direction: tuple[float, ...] = (1.0, 0.0)

    def __post_init__(self) -> None:
        check_fields(self, direction=unit_direction(self.direction))

    def ar_model(self, frame_rate_hz: float) -> ARModel:
        """Return the AR2 process of this rms, sampled at a frame rate [Hz].

        A line that is not below the Nyquist frequency raises a ProblemError.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100)
        >>> round(line.ar_model(800).rms_nm, 6)
        100.0
        """
        rate = number(frame_rate_hz, "frame_rate_hz", above=0)
        a, driving = sampled_lines(
            np.array(self.frequency_hz), np.array(self.damping), self.rms_nm, rate
        )
        return ARModel(coefficients=a, driving_rms_nm=float(driving), frame_rate_hz=rate)

    def retuned(self, frequency_hz: float, *, frame_rate_hz: float, hold: str = "rms") -> Vibration:
        """Return this vibration at another frequency [Hz], for a loop of a frame rate [Hz].

        ``hold`` says what stays: the rms of the vibration, "rms", or that of its driving noise,
        "driving". A value out of its range raises a ProblemError.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100)
        >>> round(line.retuned(18, frame_rate_hz=800, hold="driving").rms_nm, 2)
        117.01
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

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100)
        >>> line.at_frequency(25).damping
        0.008
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
    return tuple(float(v) for v in vector / length)


def require_below_nyquist(frequency_hz: float, frame_rate_hz: float) -> None:
    """Refuse a vibration that a frame rate does not sample."""
    if not frequency_hz < frame_rate_hz / 2:
        raise ProblemError(
            f"a vibration must lie below the Nyquist frequency {frame_rate_hz / 2:.6g} Hz; "
            f"got {frequency_hz:.6g} Hz. Give the frequency it is aliased to."
        )


def sampled_lines(
    frequency_hz: FloatArray, damping: FloatArray, rms_nm: FloatArray | float, frame_rate_hz: float
) -> tuple[FloatArray, FloatArray]:
    """Coefficients (p, 2) and driving noise (p,) [nm] of p vibrations at a frame rate."""
    require_below_nyquist(float(np.max(frequency_hz, initial=0.0)), frame_rate_hz)
    a = coefficient_rows(2 * np.pi * frequency_hz / frame_rate_hz, damping)
    # by the rounded coefficients, so that the process has exactly this rms
    return a, np.asarray(rms_nm / np.sqrt(variance_ratios(a)))
