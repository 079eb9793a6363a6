"""Power spectra: auto-regressive processes of any order, tables, and sums of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import (
    FloatArray,
    IntArray,
    Positive,
    check_fields,
    frozen_copy,
    positive,
    real_array,
    sequence,
    set_fields,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ARModel:
    """Stationary process ``x(k+1) = a1 x(k) + a2 x(k-1) + ... + v(k)``, or a stack of them.

    A stack holds one process for each mode, or for each loop of an ensemble.

    Parameters
    ----------
    coefficients : (order,) or (k, order) array_like
        a1, a2, ... of the process, or of each of k.
    driving_rms_nm : float or (k,) array_like
        Standard deviation of the white noise v [nm].
    frame_rate_hz : float
        Sampling frequency [Hz].

    Raises
    ------
    ProblemError
        If a value is not finite, a process is not stationary, or sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> ar1 = lbt.models.ARModel(coefficients=[0.6], driving_rms_nm=8.0, frame_rate_hz=1000)
    >>> round(ar1.rms_nm, 6)
    10.0
    >>> air = lbt.models.ARModel(
    ...     coefficients=[[0.99], [0.98]], driving_rms_nm=[10.0, 5.0], frame_rate_hz=800
    ... )
    >>> air.count, air.rms_nm.round(2).tolist()
    (2, [70.89, 25.13])
    """

    coefficients: FloatArray
    driving_rms_nm: Any
    frame_rate_hz: Positive

    def __post_init__(self) -> None:
        a = np.atleast_1d(real_array(self.coefficients, "coefficients"))
        driving = positive(self.driving_rms_nm, "driving_rms_nm")
        if a.ndim > 2 or a.size == 0 or driving.shape != a.shape[:-1]:
            raise DimensionError(
                "coefficients must be at least one number, or a row of as many for each process, "
                "and driving_rms_nm one number for each process; got shapes "
                f"{a.shape} and {driving.shape}."
            )
        driving_rms_nm = driving if driving.ndim else float(driving)
        check_fields(self, coefficients=frozen_copy(a), driving_rms_nm=driving_rms_nm)
        radii = np.atleast_1d(np.abs(np.linalg.eigvals(self.companion)).max(axis=-1))
        with np.errstate(all="ignore"):
            ratios = np.atleast_1d(variance_ratios(a))
        unstable = np.flatnonzero(~((radii < 1) & (ratios > 0) & (ratios < np.inf)))
        if unstable.size:
            first = int(unstable[0])
            where = "" if a.ndim == 1 else f" of process {first}"
            raise ProblemError(
                "an AR model must be stationary, all poles inside the unit circle; got a pole"
                f"{where} of modulus {radii[first]:.9g} and no finite variance. "
                "Check the signs: x(k+1) = a1 x(k) + a2 x(k-1) + ... + v(k)."
            )

    @classmethod
    def stack(cls, models: ARModel | Sequence[ARModel]) -> ARModel:
        """Return models of any orders as one stack, in which shorter ones have zeros.

        Anything but ARModels, and different frame rates, raise a ProblemError.
        """
        members = (models,) if isinstance(models, ARModel) else sequence(models, "models")
        if not members or not all(isinstance(model, ARModel) for model in members):
            kinds = sorted({type(model).__name__ for model in members}) or "an empty list"
            raise ProblemError(f"models must be one ARModel a mode; got {kinds}.")
        rate, order = members[0].frame_rate_hz, max(model.order for model in members)
        if not all(np.isclose(model.frame_rate_hz, rate, rtol=1e-9) for model in members):
            raise ProblemError("all models must be sampled at the same frame rate; they are not.")
        rows = [np.atleast_2d(model.coefficients) for model in members]
        padded = [np.pad(row, ((0, 0), (0, order - row.shape[1]))) for row in rows]
        return cls(
            coefficients=np.concatenate(padded),
            driving_rms_nm=np.concatenate([np.atleast_1d(m.driving_rms_nm) for m in members]),
            frame_rate_hz=rate,
        )

    @property
    def order(self) -> int:
        """Number of coefficients of a process."""
        return int(self.coefficients.shape[-1])

    @property
    def count(self) -> int:
        """Number of processes."""
        return len(np.atleast_2d(self.coefficients))

    def take(self, rows: int | IntArray) -> ARModel:
        """Return one process of a stack, or some."""
        return replace(
            self, coefficients=self.coefficients[rows], driving_rms_nm=self.driving_rms_nm[rows]
        )

    def separate(self) -> tuple[ARModel, ...]:
        """Return the processes of a stack one by one."""
        if self.coefficients.ndim == 1:
            return (self,)
        return tuple(self.take(i) for i in range(self.count))

    @property
    def companion(self) -> FloatArray:
        """State matrix (order, order) of the state [x(k), x(k-1), ...], or (k, order, order)."""
        return companions(self.coefficients)

    @property
    def rms_nm(self) -> Any:
        """Stationary standard deviation [nm], a float or (k,)."""
        rms_nm = self.driving_rms_nm * np.sqrt(variance_ratios(self.coefficients))
        return frozen_copy(rms_nm) if rms_nm.ndim else float(rms_nm)

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """One-sided power spectrum [nm^2/Hz] at frequencies [Hz] up to Nyquist, of their shape.

        It is ``2 s^2 / (f_s |1 - a1 z^-1 - a2 z^-2 - ...|^2)``; that of a stack is (k, f). A
        frequency that is not finite raises a ProblemError.
        """
        frequency = real_array(frequency_hz, "frequency_hz")
        density = densities(self.coefficients, self.driving_rms_nm, self.frame_rate_hz, frequency)
        return density.reshape((*self.coefficients.shape[:-1], *frequency.shape))


def companions(coefficients: FloatArray) -> FloatArray:
    """State matrices (..., order, order) of AR processes with coefficients (..., order)."""
    order = coefficients.shape[-1]
    A = np.zeros((*coefficients.shape, order))
    A[..., 0, :] = coefficients
    A[..., 1:, :-1] = np.eye(order - 1)
    return A


def densities(
    coefficients: FloatArray, driving_rms: FloatArray | float, rate_hz: float, frequency: FloatArray
) -> FloatArray:
    """One-sided power spectra (..., f) of AR processes (..., order) at f frequencies."""
    delay = np.exp(-2j * np.pi * frequency.ravel() / rate_hz)
    lags = delay ** np.arange(1, coefficients.shape[-1] + 1)[:, None]
    drive = np.asarray(2 * np.square(driving_rms) / rate_hz)
    return np.asarray(drive[..., None] / np.abs(1 - coefficients @ lags) ** 2)


def variance_ratios(coefficients: FloatArray) -> FloatArray:
    """Variance over that of the driving noise, for processes (..., order), (...).

    By stepping down Levinson's recursion: with the reflection coefficients r the ratio is
    ``1 / prod(1 - r^2)``. This loses fewer digits than a Lyapunov equation when the poles
    crowd at the unit circle.
    """
    a = np.array(coefficients, dtype=np.float64)
    ratio = np.ones(a.shape[:-1])
    while a.shape[-1]:
        r, rest = a[..., -1:], a[..., :-1]
        ratio = ratio / ((1 - r) * (1 + r))[..., 0]
        # (rest + r back) / ((1 - r) (1 + r)) without its cancellation near r = -1
        back = rest[..., ::-1]
        a = (rest + back) / (2 * (1 - r)) + (rest - back) / (2 * (1 + r))
    return np.asarray(ratio, dtype=np.float64)


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
        kinks = [breakpoints_below(spectrum, np.inf) for spectrum in self.parts]
        return frozen_copy(np.unique(np.concatenate(kinks)))

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """Return the spectrum at frequencies [Hz], the sum of the parts' [nm^2/Hz]."""
        x = real_array(frequency_hz, "frequency_hz")
        return np.asarray(sum(spectrum.psd(x) for spectrum in self.parts), dtype=np.float64)


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


def spectrum_groups(spectra: Sequence[Spectrum | None]) -> list[tuple[Spectrum, list[int]]]:
    """Return the different spectra of some modes, each with the modes that have it.

    AR models of the same numbers are one spectrum; modes without a spectrum are left out.
    """
    groups: dict[object, tuple[Spectrum, list[int]]] = {}
    for mode, spectrum in enumerate(spectra):
        key: object = id(spectrum)
        if isinstance(spectrum, ARModel):
            numbers = spectrum.coefficients.tobytes(), np.asarray(spectrum.driving_rms_nm).tobytes()
            key = *numbers, spectrum.frame_rate_hz
        if spectrum is not None:
            groups.setdefault(key, (spectrum, []))[1].append(mode)
    return list(groups.values())
