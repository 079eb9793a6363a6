"""What the telescope really does, apart from what the design believes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.ar import ARModel
from lbt_synth.models.drifting_vibration import DriftingVibration
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.vibration import Vibration
from lbt_synth.validation import FloatArray, frozen, number, real_array, sequence


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
    >>> flat = lbt.models.TabulatedSpectrum(frequency_hz=[10, 20], density_nm2_hz=[4, 4])
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SumSpectrum:
    """The spectrum of several independent disturbances together.

    Parameters
    ----------
    parts : sequence of Spectrum
        Their spectra, at least one; spectra that are sums themselves are taken apart.

    Raises
    ------
    ProblemError
        If there is none, or one has no method ``psd(frequency_hz)``.

    Examples
    --------
    A measured spectrum upon turbulence that it does not hold:

    >>> import lbt_synth as lbt
    >>> air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=10, diameter_m=8)
    >>> hum = lbt.models.TabulatedSpectrum(frequency_hz=[49, 50, 51], density_nm2_hz=[0, 100, 0])
    >>> [float(v) for v in lbt.models.SumSpectrum(parts=[air, hum]).psd([50.0]).round(1)]
    [100.0]
    """

    parts: tuple[Spectrum, ...]

    def __post_init__(self) -> None:
        given = sequence(self.parts, "parts")
        for part in given:
            if not isinstance(part, Spectrum):
                raise ProblemError(
                    f"parts must have a method psd(frequency_hz); got {type(part).__name__}."
                )
        if not given:
            raise ProblemError("parts must hold at least one spectrum; got none.")
        flat: list[Spectrum] = []
        for part in given:
            flat += part.parts if isinstance(part, SumSpectrum) else (part,)
        object.__setattr__(self, "parts", tuple(flat))

    @property
    def breakpoints_hz(self) -> FloatArray:
        """Frequencies where one of the parts says that it has kinks [Hz]."""
        kinks = [breakpoints_below(part, np.inf) for part in self.parts]
        return frozen(np.unique(np.concatenate(kinks)))

    def psd(self, frequency_hz: Any) -> FloatArray:
        """Return the spectrum at frequencies [Hz], the sum of the parts' [nm^2/Hz]."""
        x = real_array(frequency_hz, "frequency_hz")
        return np.asarray(sum(part.psd(x) for part in self.parts), dtype=np.float64)


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
    >>> round(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=797).amplitude_nm, 1)
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
    """Return the direction (n,) of a vibration that fits a loop."""
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
    """Return vibrations, none of which drifts."""
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
    turbulence : Spectrum, sequence of (Spectrum or None), or None
        Spectrum of each mode, the modes independent: one for all of them, or one a mode; None
        for no turbulence.
    vibrations : tuple of Vibration, SinusoidalVibration or DriftingVibration, optional
        The vibrations that are really there. One that drifts can be simulated only.
    noise_nm : float or (q,) array_like, optional
        Standard deviation of the noise on each measurement, per frame [nm]: one for all of
        them, or one a measurement.
    sensor_gain : float, optional
        Real sensor (optical) gain relative to the sensor matrix:
        ``y = sensor_gain D phi_res + noise``. Gains that differ between the axes belong into
        the sensor matrix of the loop.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.
    DimensionError
        If a sequence is empty, or ``noise_nm`` has more than one dimension.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> calm = lbt.Truth(turbulence=None, noise_nm=15.5)
    >>> calm.sensor_gain
    1.0

    Tip and tilt that differ:

    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40, frame_rate_hz=800)
    >>> uneven = lbt.Truth(turbulence=[slow, None], noise_nm=[15.5, 12.0])
    >>> [modes for _, modes in uneven.turbulence_groups(2)]
    [(0,)]
    >>> uneven.noise_of(2).tolist()
    [15.5, 12.0]
    """

    turbulence: Spectrum | Sequence[Spectrum | None] | None
    vibrations: tuple[TrueVibration, ...] = ()
    noise_nm: float | FloatArray = 0.0
    sensor_gain: float = 1.0

    def __post_init__(self) -> None:
        given = self.turbulence
        if isinstance(given, Sequence):
            object.__setattr__(self, "turbulence", tuple(given))
            if len(given) == 0:
                raise DimensionError(
                    "turbulence must be one spectrum, or one a mode; got an empty sequence. For "
                    "no turbulence give None."
                )
        for part in self._per_mode or (self.turbulence,):
            if part is not None and not isinstance(part, Spectrum):
                raise ProblemError(
                    "turbulence must have a method psd(frequency_hz), or be None, or a sequence "
                    f"of these, one a mode; got {type(part).__name__}."
                )
        object.__setattr__(self, "vibrations", tuple(self.vibrations))
        object.__setattr__(self, "noise_nm", _deviations(self.noise_nm))
        object.__setattr__(self, "sensor_gain", number(self.sensor_gain, "sensor_gain", above=0))

    @property
    def drifts(self) -> bool:
        """Whether a vibration drifts: then it can be simulated, and nothing else."""
        return any(isinstance(line, DriftingVibration) for line in self.vibrations)

    @property
    def _per_mode(self) -> tuple[Spectrum | None, ...] | None:
        """Spectra one a mode, None where one serves all modes."""
        return self.turbulence if isinstance(self.turbulence, tuple) else None

    @property
    def is_uniform(self) -> bool:
        """Whether one spectrum serves all modes."""
        return self._per_mode is None

    def turbulence_of(self, modes: int) -> tuple[Spectrum | None, ...]:
        """Return the turbulence of each mode.

        Parameters
        ----------
        modes : int
            Number of modes n of the loop.

        Returns
        -------
        tuple of Spectrum or None
            One a mode.

        Raises
        ------
        DimensionError
            If there are spectra for another number of modes.
        """
        given = self._per_mode
        if given is None:
            return (self.turbulence,) * modes  # type: ignore[return-value]
        if len(given) != modes:
            raise DimensionError(
                f"turbulence must be one spectrum, or one a mode ({modes}); got {len(given)}."
            )
        return given

    def turbulence_groups(self, modes: int) -> tuple[tuple[Spectrum, tuple[int, ...]], ...]:
        """Return the different spectra, each with the modes that have it.

        Parameters
        ----------
        modes : int
            Number of modes n of the loop.

        Returns
        -------
        tuple of (Spectrum, tuple of int)
            Modes without turbulence are left out; equal AR models are one spectrum.

        Raises
        ------
        DimensionError
            If there are spectra for another number of modes.
        """
        found: dict[object, tuple[Spectrum, list[int]]] = {}
        for mode, spectrum in enumerate(self.turbulence_of(modes)):
            if spectrum is not None:
                found.setdefault(spectrum_key(spectrum), (spectrum, []))[1].append(mode)
        return tuple((spectrum, tuple(own)) for spectrum, own in found.values())

    def noise_of(self, measurements: int) -> FloatArray:
        """Return the standard deviation of the noise on each measurement, (q,) [nm].

        Parameters
        ----------
        measurements : int
            Number of measurements q of the loop.

        Returns
        -------
        (q,) ndarray
            One a measurement.

        Raises
        ------
        DimensionError
            If there are deviations for another number of measurements.
        """
        if np.ndim(self.noise_nm) and np.size(self.noise_nm) != measurements:
            raise DimensionError(
                f"noise_nm must be one number, or one a measurement ({measurements}); "
                f"got {np.size(self.noise_nm)}."
            )
        return frozen(np.broadcast_to(self.noise_nm, (measurements,)))


def spectrum_key(spectrum: Spectrum | None) -> object:
    """Return what two equal spectra share: the numbers of an AR model, else which object it is."""
    if isinstance(spectrum, ARModel):
        return (
            spectrum.coefficients.tobytes(),
            repr(spectrum.driving_rms_nm),
            spectrum.frame_rate_hz,
        )
    return id(spectrum)


def _deviations(noise_nm: Any) -> float | FloatArray:
    """Return one deviation for all measurements, or one a measurement."""
    if np.ndim(noise_nm) == 0:
        return number(noise_nm, "noise_nm", at_least=0)
    out = real_array(noise_nm, "noise_nm")
    if out.ndim != 1 or out.size == 0:
        raise DimensionError(
            f"noise_nm must be one number, or a list of one a measurement; got shape {out.shape}."
        )
    for value in out:
        number(value, "noise_nm", at_least=0)
    return out
