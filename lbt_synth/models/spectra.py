"""Power spectra: their interface, tables, and sums of several."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.ar_model import ARModel
from lbt_synth.validation import FloatArray, frozen_copy, real_array, sequence, set_fields


@runtime_checkable
class Spectrum(Protocol):
    """Anything with a one-sided power spectrum [nm^2/Hz]: Atmosphere, ARModel, a table."""

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """Return the spectrum at frequencies [Hz]."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TabulatedSpectrum:
    """A measured one-sided spectrum, interpolated linearly, zero outside its range.

    Parameters
    ----------
    frequency_hz, density_nm2_hz : (f,) array_like
        Increasing frequencies [Hz]; spectrum [nm^2/Hz], at least 0.

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
        set_fields(self, frequency_hz=f, density_nm2_hz=s)

    @property
    def breakpoints_hz(self) -> FloatArray:
        """Frequencies where the spectrum has kinks [Hz]."""
        return self.frequency_hz

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """Return the spectrum at frequencies [Hz] by linear interpolation [nm^2/Hz]."""
        x = real_array(frequency_hz, "frequency_hz")
        return np.asarray(np.interp(x, self.frequency_hz, self.density_nm2_hz, left=0, right=0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SumSpectrum:
    """The spectrum of several independent disturbances together.

    Parameters
    ----------
    parts : sequence of Spectrum
        Their spectra, at least one; sums among them are taken apart.

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
        flat: list[Spectrum] = []
        for part in sequence(self.parts, "parts"):
            if not isinstance(part, Spectrum):
                raise ProblemError(
                    f"parts must have a method psd(frequency_hz); got {type(part).__name__}."
                )
            flat += part.parts if isinstance(part, SumSpectrum) else (part,)
        if not flat:
            raise ProblemError("parts must hold at least one spectrum; got none.")
        set_fields(self, parts=tuple(flat))

    @property
    def breakpoints_hz(self) -> FloatArray:
        """Frequencies where one of the parts says that it has kinks [Hz]."""
        kinks = [breakpoints_below(part, np.inf) for part in self.parts]
        return frozen_copy(np.unique(np.concatenate(kinks)))

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """Return the spectrum at frequencies [Hz], the sum of the parts' [nm^2/Hz]."""
        x = real_array(frequency_hz, "frequency_hz")
        return np.asarray(sum(part.psd(x) for part in self.parts), dtype=np.float64)


def spectrum_density(spectrum: Spectrum, frequency_hz: FloatArray) -> FloatArray:
    """Return the density of a spectrum [nm^2/Hz], one number of at least 0 for each frequency."""
    density = np.asarray(spectrum.psd(frequency_hz))
    if (
        density.shape != frequency_hz.shape
        or density.dtype.kind not in "fiu"
        or not np.all(np.isfinite(density) & (density >= 0))
    ):
        raise ProblemError(
            "a spectrum must return one finite number of at least 0 for each frequency; "
            f"{type(spectrum).__name__}.psd does not between {np.min(frequency_hz):.6g} and "
            f"{np.max(frequency_hz):.6g} Hz."
        )
    return density.astype(np.float64)


def breakpoints_below(spectrum: Spectrum, limit_hz: float) -> FloatArray:
    """Frequencies in (0, limit) at which a spectrum declares kinks [Hz]."""
    points = np.asarray(getattr(spectrum, "breakpoints_hz", ()), dtype=np.float64)
    return points[(points > 0) & (points < limit_hz)]


def spectrum_key(spectrum: Spectrum | None) -> object:
    """Return a key that equal spectra share: the numbers of an AR model, else its identity."""
    if isinstance(spectrum, ARModel):
        return (
            spectrum.coefficients.tobytes(),
            repr(spectrum.driving_rms_nm),
            spectrum.frame_rate_hz,
        )
    return id(spectrum)
