"""Frozen flows of many seeings, wind speeds and outer scales over one telescope.

The spectrum scales with ``seeing^(5/3)`` and is a function of ``f D / V``, so only each outer
scale needs a table. Over an octave of the outer scale, a polynomial interpolates the logarithm
of the spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike
from scipy.interpolate import PPoly

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.turbulence.atmosphere import (
    Atmosphere,
    LogSpline,
    tilt_spline,
    tilt_strength_nm2,
    tilt_variance,
)
from lbt_synth.validation import FloatArray, IntArray, check_fields, positive, real_array

_PER_LOOP = ("seeing_arcsec", "wind_speed_m_s", "outer_scale_m")
_TERMS = 12  # of the polynomial over an octave of the outer scale
_FEW_SCALES = 16  # up to this many outer scales have a table each


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrozenFlows:
    """Frozen von Karman layers, one per loop, over the telescope of one atmosphere.

    Parameters
    ----------
    atmosphere : Atmosphere
        The telescope, and the default values.
    seeing_arcsec, wind_speed_m_s, outer_scale_m : (p,) array_like, optional
        Seeing [arcsec], wind speed [m/s] and outer scale [m] of each loop, or one number for
        all; those of the atmosphere by default.

    Raises
    ------
    ProblemError
        If a value is not above 0.
    DimensionError
        If they are not lists of the same length.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.Atmosphere(
    ...     seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22
    ... )
    >>> flows = lbt.models.FrozenFlows(atmosphere=air, seeing_arcsec=[0.8, 1.6])
    >>> (flows.psd([5.0]) / air.psd([5.0])).round(4).ravel().tolist()
    [1.0, 3.1748]
    """

    atmosphere: Atmosphere
    seeing_arcsec: Any = None
    wind_speed_m_s: Any = None
    outer_scale_m: Any = None

    def __post_init__(self) -> None:
        check_fields(self)
        given = {}
        for name in _PER_LOOP:
            value = getattr(self, name)
            value = getattr(self.atmosphere, name) if value is None else value
            if value is None:  # Kolmogorov
                continue
            given[name] = np.atleast_1d(positive(value, name))
        try:
            arrays = np.broadcast_arrays(*given.values())
        except ValueError as error:
            shapes = ", ".join(f"{name} {value.shape}" for name, value in given.items())
            raise DimensionError(
                f"seeing, wind and outer scale must be lists of the same length; got {shapes}."
            ) from error
        if arrays[0].ndim != 1:
            raise DimensionError(f"they must be lists, one number per loop; got {arrays[0].shape}.")
        check_fields(self, **dict(zip(given, arrays, strict=True)))

    def __len__(self) -> int:
        """Return the number of loops p."""
        return int(self.seeing_arcsec.size)

    def take(self, rows: IntArray) -> FrozenFlows:
        """Return the flows of some loops."""
        given = {name: getattr(self, name) for name in _PER_LOOP}
        return replace(self, **{n: value[rows] for n, value in given.items() if value is not None})

    @property
    def tilt_rms_nm(self) -> FloatArray:
        """Standard deviation of tip, and of tilt, of each loop [nm rms wavefront], (p,)."""
        ratios, which = np.unique(self._scale_ratio, return_inverse=True)
        obstruction = self.atmosphere.obstruction
        variances = np.array([tilt_variance(float(ratio), obstruction) for ratio in ratios])
        return np.asarray(np.sqrt(self._strength * variances[which.reshape(-1)]))

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """One-sided temporal power spectra (p, f) of one axis [nm^2/Hz] at frequencies (f,) [Hz].

        A frequency that is not a finite number above 0 raises a ProblemError.
        """
        shapes, which, factors = self.factored_psd(frequency_hz)
        return np.asarray(shapes[which] * factors[:, None])

    def factored_psd(self, frequency_hz: ArrayLike) -> tuple[FloatArray, IntArray, FloatArray]:
        """Shapes (u, f) of the spectra, which of them each loop has, and its factor, (p,) each.

        Spectra of the same wind and outer scale have one shape. For the frequencies see
        :meth:`psd`.
        """
        frequency = real_array(frequency_hz, "frequency_hz")
        if frequency.ndim != 1 or np.any(frequency <= 0):
            raise ProblemError("frequency_hz must be a list of frequencies above 0 Hz.")
        air = self.atmosphere
        crossing_s = air.diameter_m / self.wind_speed_m_s
        # pairs as complex numbers, which are sorted several times faster
        unique, which = np.unique(crossing_s + 1j * self._scale_ratio, return_inverse=True)
        x = np.log(frequency) + np.log(unique.real[:, None])
        values = np.empty(x.shape)
        ratios = np.unique(unique.imag)
        if len(ratios) <= _FEW_SCALES:
            for ratio in ratios:
                rows = unique.imag == ratio
                values[rows] = tilt_spline(float(ratio), air.obstruction)(x[rows])
        else:
            _interpolate_over_scales(x, unique.imag, air.obstruction, values)
        return np.exp(values), which.reshape(-1), self._strength * crossing_s

    @property
    def _strength(self) -> FloatArray:
        seeing = self.seeing_arcsec / self.atmosphere.seeing_arcsec
        return np.asarray(tilt_strength_nm2(self.atmosphere) * seeing ** (5 / 3))

    @property
    def _scale_ratio(self) -> FloatArray:
        if self.outer_scale_m is None:
            return np.zeros(len(self))
        return np.asarray(self.atmosphere.diameter_m / self.outer_scale_m)


def _interpolate_over_scales(
    x: FloatArray, scale_ratio: FloatArray, obstruction: float, values: FloatArray
) -> None:
    """Fill in the logarithms of spectra that each have their own outer scale."""
    octave = np.floor(np.log2(scale_ratio))
    for each in np.unique(octave):
        knots, coefficients = _octave_splines(int(each), obstruction)
        rows = np.flatnonzero(octave == each)
        place = 2 * (np.log2(scale_ratio[rows]) - each) - 1
        for row, terms in zip(rows, chebyshev.chebvander(place, _TERMS - 1), strict=True):
            spline = PPoly(coefficients @ terms, knots)
            values[row] = LogSpline(spline=spline)(x[row])


@lru_cache(maxsize=16)
def _octave_splines(octave: int, obstruction: float) -> tuple[FloatArray, FloatArray]:
    """Knots, and spline coefficients (4, intervals, terms), over one octave of outer scales.

    The coefficients are polynomials in the logarithm of the diameter over the outer scale.
    """
    nodes = chebyshev.chebpts1(_TERMS)
    ratios = 2.0 ** (octave + (nodes + 1) / 2)
    splines = [tilt_spline(float(ratio), obstruction).spline for ratio in ratios]
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, _TERMS - 1))
    stacked = np.stack([spline.c for spline in splines], axis=-1)
    return splines[0].x, stacked @ inverse.T
