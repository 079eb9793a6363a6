"""What the telescope really does, apart from what the design believes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.drift import DriftingVibration
from lbt_synth.models.hardware import LoopHardware
from lbt_synth.models.vibration import Vibration
from lbt_synth.validation import FloatArray, number, real_array


@runtime_checkable
class Spectrum(Protocol):
    """Anything with a one-sided power spectrum [nm^2/Hz]: Atmosphere, ARModel, a table."""

    def psd(self, frequency_hz: Any) -> FloatArray:
        """Return the spectrum at frequencies [Hz]."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TabulatedSpectrum:
    """A measured one-sided spectrum, interpolated linearly, zero outside its range.

    Parameters
    ----------
    frequency_hz : (f,) array_like
        Increasing frequencies [Hz].
    density_nm2_hz : (f,) array_like
        Spectrum [nm^2/Hz], at least 0.

    Raises
    ------
    ProblemError
        If the table is not finite, not increasing or negative.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> flat = lbt.TabulatedSpectrum(frequency_hz=[10, 20], density_nm2_hz=[4, 4])
    >>> [float(v) for v in flat.psd([5, 15, 25])]
    [0.0, 4.0, 0.0]
    """

    frequency_hz: FloatArray
    density_nm2_hz: FloatArray

    def __post_init__(self) -> None:
        f = real_array(self.frequency_hz, "frequency_hz")
        s = real_array(self.density_nm2_hz, "density_nm2_hz")
        if f.ndim != 1 or f.shape != s.shape or f.size < 2:
            raise DimensionError(
                "frequency_hz and density_nm2_hz must be lists of the same length, at least 2; "
                f"got {f.shape} and {s.shape}."
            )
        if np.any(np.diff(f) <= 0) or f[0] < 0:
            raise ProblemError("frequency_hz must increase from at least 0; it does not.")
        if np.any(s < 0):
            raise ProblemError(f"density_nm2_hz must be at least 0; got {np.min(s):.6g}.")
        object.__setattr__(self, "frequency_hz", f)
        object.__setattr__(self, "density_nm2_hz", s)

    @property
    def breakpoints_hz(self) -> FloatArray:
        """Frequencies where the spectrum has kinks [Hz]."""
        return self.frequency_hz

    def psd(self, frequency_hz: Any) -> FloatArray:
        """Return the spectrum at frequencies [Hz] by linear interpolation [nm^2/Hz]."""
        x = real_array(frequency_hz, "frequency_hz")
        return np.asarray(np.interp(x, self.frequency_hz, self.density_nm2_hz, left=0, right=0))


@dataclass(frozen=True, slots=True, kw_only=True)
class SinusoidalVibration:
    """A vibration that is a pure sinusoid.

    Parameters
    ----------
    frequency_hz : float
        Frequency [Hz].
    rms_nm : float
        Standard deviation, amplitude / sqrt(2), along its direction [nm rms wavefront].
    direction : tuple of float, optional
        Direction over the modes, made a unit vector.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(lbt.SinusoidalVibration(frequency_hz=20, rms_nm=797).amplitude_nm, 1)
    1127.1
    """

    frequency_hz: float
    rms_nm: float
    direction: tuple[float, ...] = (1.0, 0.0)

    def __post_init__(self) -> None:
        # a line has the same frequency, rms and direction; its damping plays no part
        line = Vibration(
            frequency_hz=self.frequency_hz,
            damping=0.5,
            rms_nm=self.rms_nm,
            direction=self.direction,
        )
        for name in ("frequency_hz", "rms_nm", "direction"):
            object.__setattr__(self, name, getattr(line, name))

    @property
    def amplitude_nm(self) -> float:
        """Peak displacement [nm rms wavefront]."""
        return float(np.sqrt(2) * self.rms_nm)


TrueVibration: TypeAlias = Vibration | SinusoidalVibration | DriftingVibration


def breakpoints_below(spectrum: Spectrum, limit_hz: float) -> FloatArray:
    """Frequencies in (0, limit) at which a spectrum says that it has kinks [Hz]."""
    points = np.asarray(getattr(spectrum, "breakpoints_hz", ()), dtype=np.float64)
    return points[(points > 0) & (points < limit_hz)]


def fitted_direction(vibration: TrueVibration, hardware: LoopHardware) -> FloatArray:
    """Return the direction (n,) of a vibration that fits a loop.

    Raises
    ------
    DimensionError
        If it has another number of modes.
    ProblemError
        If it does not lie below the Nyquist frequency.
    """
    if isinstance(vibration, DriftingVibration):
        frequency_hz = vibration.highest_hz
    else:
        frequency_hz = vibration.frequency_hz
    if len(vibration.direction) != hardware.modes:
        raise DimensionError(
            f"the direction of a vibration must have {hardware.modes} components, one a mode; "
            f"got {len(vibration.direction)} at {frequency_hz:.6g} Hz."
        )
    nyquist = hardware.frame_rate_hz / 2
    if not frequency_hz < nyquist:
        raise ProblemError(
            f"a vibration must lie below the Nyquist frequency {nyquist:.6g} Hz; "
            f"got {frequency_hz:.6g} Hz."
        )
    return np.array(vibration.direction)


def stationary_vibrations(
    vibrations: Iterable[TrueVibration],
) -> tuple[Vibration | SinusoidalVibration, ...]:
    """Return vibrations, none of which drifts.

    Raises
    ------
    ProblemError
        If one drifts.
    """
    still = []
    for vibration in vibrations:
        if isinstance(vibration, DriftingVibration):
            raise ProblemError(
                "this needs a truth that is stationary; got a vibration that drifts from "
                f"{vibration.start_hz:.6g} to {vibration.end_hz:.6g} Hz. Simulate it, or take a "
                "Vibration or SinusoidalVibration at the frequencies in question."
            )
        still.append(vibration)
    return tuple(still)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """Disturbances and sensor of the real loop.

    Parameters
    ----------
    turbulence : Spectrum or None
        Spectrum of each mode, the modes independent; None for no turbulence.
    vibrations : tuple of Vibration, SinusoidalVibration or DriftingVibration, optional
        The vibrations that are really there. One that drifts can be simulated only.
    noise_nm : float, optional
        Standard deviation of the noise on each measurement, per frame [nm].
    sensor_gain : float, optional
        Real sensor (optical) gain relative to the sensor matrix:
        ``y = sensor_gain D phi_res + noise``.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> calm = lbt.Truth(turbulence=None, noise_nm=15.5)
    >>> calm.sensor_gain
    1.0
    """

    turbulence: Spectrum | None
    vibrations: tuple[TrueVibration, ...] = ()
    noise_nm: float = 0.0
    sensor_gain: float = 1.0

    def __post_init__(self) -> None:
        if self.turbulence is not None and not isinstance(self.turbulence, Spectrum):
            raise ProblemError(
                "turbulence must have a method psd(frequency_hz), or be None; "
                f"got {type(self.turbulence).__name__}."
            )
        object.__setattr__(self, "vibrations", tuple(self.vibrations))
        object.__setattr__(self, "noise_nm", number(self.noise_nm, "noise_nm", at_least=0))
        object.__setattr__(self, "sensor_gain", number(self.sensor_gain, "sensor_gain", above=0))
