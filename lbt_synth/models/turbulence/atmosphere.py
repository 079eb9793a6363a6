"""Tip and tilt of a von Karman turbulence layer that the wind carries along.

Sources: R. J. Noll, J. Opt. Soc. Am. 66, 207 (1976), doi:10.1364/JOSA.66.000207
(Zernike filter functions); J.-M. Conan, G. Rousset, P.-Y. Madec, J. Opt. Soc.
Am. A 12, 1559 (1995), doi:10.1364/JOSAA.12.001559 (temporal spectra under
Taylor's hypothesis). The spectrum scales with ``seeing^(5/3)`` and is a function of ``f D / V``,
so that of many flows only each outer scale needs a table. Over an octave of the outer scale, a
polynomial interpolates the logarithm of the spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebpts1
from numpy.typing import ArrayLike
from scipy.interpolate import BarycentricInterpolator, CubicSpline, PPoly
from scipy.special import j0, j1

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.validation import (
    FloatArray,
    IntArray,
    Obstruction,
    Positive,
    check_fields,
    positive,
    real_array,
)

ARCSEC_RAD = np.pi / 180 / 3600
LOWEST = 1e-4  # spectra are constant below this frequency, in units of V / D
_AT_ONCE = 10  # frequencies of a spectrum that are integrated together, in the cache
_VON_KARMAN = 0.0228956  # phase spectrum constant, Noll's 0.023 to more digits


_PER_LOOP = ("seeing_arcsec", "wind_speed_m_s", "outer_scale_m")  # what a stack has for each loop
_TERMS = 12  # of the polynomial over an octave of the outer scale


@dataclass(frozen=True, slots=True, kw_only=True)
class Atmosphere:
    """One frozen layer of von Karman turbulence in front of a telescope, or one for each loop.

    Parameters
    ----------
    seeing_arcsec : float or (p,) array_like
        Seeing (full width at half maximum) at ``seeing_wavelength_um`` [arcsec].
    outer_scale_m : float, (p,) array_like or None
        Outer scale L0 [m]; None for Kolmogorov turbulence, L0 infinite.
    wind_speed_m_s : float or (p,) array_like
        Speed of the layer [m/s].
    diameter_m : float
        Telescope diameter D [m].
    obstruction, seeing_wavelength_um : float, optional
        Diameter of the central obstruction as a fraction of D; wavelength of the seeing [um].

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.
    DimensionError
        If seeing, wind and outer scale are not single numbers or lists of the same length.

    Examples
    --------
    The Large Binocular Telescope of Agapito et al. 2008, Table I:

    >>> import lbt_synth as lbt
    >>> air = lbt.Atmosphere(
    ...     seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22
    ... )
    >>> round(air.tilt_rms_nm, 1)
    591.6

    Two loops that differ in the seeing alone:

    >>> from dataclasses import replace
    >>> flows = replace(air, seeing_arcsec=[0.8, 1.6])
    >>> (flows.psd([5.0]) / air.psd([5.0])).round(4).ravel().tolist()
    [1.0, 3.1748]
    """

    seeing_arcsec: Any
    outer_scale_m: Any
    wind_speed_m_s: Any
    diameter_m: Positive
    obstruction: Obstruction = 0.0
    seeing_wavelength_um: Positive = 0.5

    def __post_init__(self) -> None:
        given = {name: getattr(self, name) for name in _PER_LOOP}
        values = {name: positive(value, name) for name, value in given.items() if value is not None}
        shapes = {value.shape for value in values.values() if value.ndim}
        if len(shapes) > 1 or any(len(shape) != 1 for shape in shapes):
            sizes = ", ".join(f"{name} {value.shape}" for name, value in values.items())
            raise DimensionError(
                "seeing, wind and outer scale must be single numbers or lists of the same length; "
                f"got {sizes}."
            )
        if shapes:
            (shape,) = shapes
            values = {name: np.broadcast_to(value, shape) for name, value in values.items()}
        check_fields(self, **{n: v if v.ndim else float(v) for n, v in values.items()})

    @property
    def count(self) -> int:
        """Number of layers."""
        return np.size(self.wind_speed_m_s)

    def take(self, rows: IntArray) -> Atmosphere:
        """Return the layers of some loops."""
        arrays = {name: getattr(self, name) for name in _PER_LOOP}
        return replace(self, **{n: value[rows] for n, value in arrays.items() if value is not None})

    @property
    def fried_parameter_m(self) -> Any:
        """Fried parameter r0 = 0.976 lambda / seeing at the seeing's wavelength [m]."""
        return 0.976 * self.seeing_wavelength_um * 1e-6 / (self.seeing_arcsec * ARCSEC_RAD)

    @property
    def tilt_rms_nm(self) -> float:
        """Standard deviation of tip, and of tilt [nm rms wavefront]."""
        variance = tilt_variance(self.scale_ratio, self.obstruction)
        return float(np.sqrt(tilt_strength_nm2(self) * variance))

    @property
    def scale_ratio(self) -> Any:
        """Telescope diameter over the outer scale; 0 for Kolmogorov turbulence."""
        return 0.0 if self.outer_scale_m is None else self.diameter_m / self.outer_scale_m

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """One-sided temporal power spectrum of one axis [nm^2/Hz] at frequencies [Hz].

        The mean over wind directions: the two axes have the same spectrum and are taken as
        independent. Its integral over frequency is ``tilt_rms_nm**2``. That of a stack is (p, f). A
        frequency that is negative or not finite raises a ProblemError.
        """
        frequency = real_array(frequency_hz, "frequency_hz")
        if np.any(frequency < 0):
            raise ProblemError(f"frequency_hz must be at least 0; got {np.min(frequency)}.")
        crossing_s = np.atleast_1d(self.diameter_m / self.wind_speed_m_s)
        # pairs as complex numbers, which are sorted several times faster
        unique, which = np.unique(crossing_s + 1j * self.scale_ratio, return_inverse=True)
        with np.errstate(divide="ignore"):
            x = np.log(frequency.ravel()) + np.log(unique.real[:, None])
        values, ratios = np.empty(x.shape), np.unique(unique.imag)
        # a polynomial over an octave needs as many tables
        spline_of = tilt_spline if len(ratios) <= _TERMS else _interpolated_spline
        for ratio in ratios:
            rows = unique.imag == ratio
            spline = spline_of(float(ratio), self.obstruction)
            first, last = spline.x[[0, -1]]
            # constant below the first knot, the power law f^(-17/3) of tilt beyond the last
            beyond = np.maximum(x[rows] - last, 0)
            values[rows] = spline(np.clip(x[rows], first, last)) - 17 / 3 * beyond
        factors = tilt_strength_nm2(self) * crossing_s
        density = np.exp(values)[which.reshape(-1)] * factors[:, None]
        return np.asarray(density.reshape((*np.shape(self.wind_speed_m_s), *frequency.shape)))


def kolmogorov_constant_nm2(air: Atmosphere) -> Any:
    """Factor of ``(f^2 + L0^-2)^(-11/6)`` in the spatial phase spectrum [nm^2 m^(-5/3)]."""
    nm_per_radian = air.seeing_wavelength_um * 1e3 / (2 * np.pi)
    return _VON_KARMAN * air.fried_parameter_m ** (-5 / 3) * nm_per_radian**2


def tilt_strength_nm2(air: Atmosphere) -> Any:
    """Factor of tilt spectra in units of the telescope's diameter [nm^2]."""
    return kolmogorov_constant_nm2(air) * air.diameter_m ** (5 / 3)


def _filtered_spectrum(scale_ratio: float, eps: float, f: FloatArray) -> FloatArray:
    """Spatial phase spectrum times the tilt filter, mean over directions.

    For a unit Kolmogorov constant, with f in cycles per diameter. The filter is Noll's for a
    disc, and the transform of the annular tilt of unit rms for an annulus.
    """
    argument = np.pi * f
    edge = _bessel_j2(argument)
    if eps > 0:
        edge = edge - eps**3 * _bessel_j2(eps * argument)
    amplitude = 2 * edge / argument
    tilt_filter = 2 * amplitude**2 / ((1 - eps**2) ** 2 * (1 + eps**2))
    return np.asarray((f**2 + scale_ratio**2) ** (-11 / 6) * tilt_filter)


def _bessel_j2(x: FloatArray) -> FloatArray:
    """J_2 to 2e-9, by its recurrence where that loses few digits, else by its series."""
    return np.where(x < 0.03, x**2 / 8 * (1 - x**2 / 12), 2 * j1(x) / x - j0(x))


@lru_cache(maxsize=2)
def _spatial_panels(*, is_flat: bool = False) -> tuple[FloatArray, FloatArray]:
    """Nodes over spatial frequency [1/D]: octaves below 1/4 unless all is flat there."""
    low = np.array([0.0, 0.25]) if is_flat else np.geomspace(1e-18, 0.25, 59)
    return gauss_panels(np.concatenate([low, [0.5], np.arange(1.0, 41.0)]), 10)


@lru_cache(maxsize=128)
def tilt_variance(scale_ratio: float, obstruction: float) -> float:
    """Variance of one axis for a unit strength."""
    f, w = _spatial_panels()
    return float(np.sum(2 * np.pi * f * w * _filtered_spectrum(scale_ratio, obstruction, f)))


@lru_cache(maxsize=128)
def tilt_spline(scale_ratio: float, obstruction: float) -> PPoly:
    """Logarithm of a temporal spectrum of unit strength over that of frequency in units of V / D.

    ``S(f) = (4 / V) int_0^inf Phi(f/V, f_y) df_y`` (one-sided).
    """
    slow = np.geomspace(LOWEST, 0.3, 120, endpoint=False)
    fast = np.concatenate([np.linspace(0.3, 12, 480, endpoint=False), np.linspace(12, 120, 400)])
    density = []
    for frequency, is_flat in ((slow, False), (fast, True)):
        fy, wy = _spatial_panels(is_flat=is_flat)
        for f in np.array_split(frequency, frequency.size // _AT_ONCE):
            spectrum = _filtered_spectrum(scale_ratio, obstruction, np.hypot(f[:, None], fy))
            density.append(4 * spectrum @ wy)
    knots = np.log(np.concatenate([slow, fast]))
    return CubicSpline(knots, np.log(np.concatenate(density)))


def _interpolated_spline(scale_ratio: float, obstruction: float) -> PPoly:
    """Return the spline of one of many outer scales."""
    place = float(np.log2(scale_ratio))
    knots, polynomial = _octave_of_splines(int(np.floor(place)), obstruction)
    return PPoly(polynomial(place), knots)


@lru_cache(maxsize=16)
def _octave_of_splines(
    octave: int, obstruction: float
) -> tuple[FloatArray, BarycentricInterpolator]:
    """Knots, and the polynomial of spline coefficients over an octave of D / L0, in its log2."""
    places = octave + (chebpts1(_TERMS) + 1) / 2
    splines = [tilt_spline(2.0 ** float(place), obstruction) for place in places]
    return splines[0].x, BarycentricInterpolator(places, [s.c for s in splines], rng=0)
