"""Frozen flows of many seeings, wind speeds and outer scales, over one telescope.

The spectrum scales with ``seeing^(5/3)``, and with the wind as ``S(f; V) = S(f V0 / V; V0) V0 /
V``: only the outer scale needs tables of its own. Over an octave of it the logarithm of the
spectrum is interpolated by a polynomial.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from scipy.interpolate import PPoly

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.atmosphere import Atmosphere, LogSpline, tilt_spline
from lbt_synth.validation import FloatArray, IntArray, instance, real_array

_TERMS = 12  # of the polynomial over an octave of the outer scale
_FEW_SCALES = 16  # outer scales that have a table each


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrozenFlows:
    """Frozen von Karman layers, one a loop, over the telescope of one atmosphere.

    Parameters
    ----------
    atmosphere : Atmosphere
        The telescope, and the values of what is not given.
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
    >>> air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20,
    ...                      diameter_m=8.22)
    >>> flows = lbt.FrozenFlows(atmosphere=air, seeing_arcsec=[0.8, 1.6])
    >>> (flows.psd([5.0]) / air.psd([5.0])).round(4).ravel().tolist()
    [1.0, 3.1748]
    """

    atmosphere: Atmosphere
    seeing_arcsec: Any = None
    wind_speed_m_s: Any = None
    outer_scale_m: Any = None

    def __post_init__(self) -> None:
        instance(self.atmosphere, Atmosphere)
        given = {}
        for name in ("seeing_arcsec", "wind_speed_m_s", "outer_scale_m"):
            value = getattr(self, name)
            value = getattr(self.atmosphere, name) if value is None else value
            if value is None:  # Kolmogorov
                continue
            given[name] = np.atleast_1d(real_array(value, name))
            if np.any(given[name] <= 0):
                raise ProblemError(f"{name} must be above 0; got {given[name].min():.6g}.")
        try:
            arrays = np.broadcast_arrays(*given.values())
        except ValueError as error:
            shapes = ", ".join(f"{name} {value.shape}" for name, value in given.items())
            raise DimensionError(
                f"seeing, wind and outer scale must be lists of the same length; got {shapes}."
            ) from error
        if arrays[0].ndim != 1:
            raise DimensionError(f"they must be lists, one number a loop; got {arrays[0].shape}.")
        for name, value in zip(given, arrays, strict=True):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        """Return the number of loops p."""
        return int(self.seeing_arcsec.size)

    def taken(self, rows: IntArray) -> FrozenFlows:
        """Return the flows of some loops."""
        outer = None if self.outer_scale_m is None else self.outer_scale_m[rows]
        return FrozenFlows(
            atmosphere=self.atmosphere if outer is not None else self._template(None),
            seeing_arcsec=self.seeing_arcsec[rows],
            wind_speed_m_s=self.wind_speed_m_s[rows],
            outer_scale_m=outer,
        )

    @property
    def tilt_rms_nm(self) -> FloatArray:
        """Standard deviation of tip, and of tilt, of each loop [nm rms wavefront], (p,)."""
        strength = (self.seeing_arcsec / self.atmosphere.seeing_arcsec) ** (5 / 6)
        if self.outer_scale_m is None:
            return np.asarray(strength * self._template(None).tilt_rms_nm)
        scales, which = np.unique(self.outer_scale_m, return_inverse=True)
        each = np.array([self._template(float(scale)).tilt_rms_nm for scale in scales])
        return np.asarray(strength * each[which])

    def psd(self, frequency_hz: Any) -> FloatArray:
        """One-sided temporal power spectra of one axis [nm^2/Hz].

        Parameters
        ----------
        frequency_hz : (f,) array_like
            Frequencies [Hz], above 0.

        Returns
        -------
        (p, f) ndarray
            Spectrum of each loop.

        Raises
        ------
        ProblemError
            If a frequency is not a finite number above 0.
        """
        frequency = real_array(frequency_hz, "frequency_hz")
        if frequency.ndim != 1 or np.any(frequency <= 0):
            raise ProblemError("frequency_hz must be a list of frequencies above 0 Hz.")
        air = self.atmosphere
        strength = (self.seeing_arcsec / air.seeing_arcsec) ** (5 / 3)
        # spectra that differ by their strength only are computed once
        shapes = [self.wind_speed_m_s]
        shapes += [] if self.outer_scale_m is None else [self.outer_scale_m]
        unique, which = np.unique(np.stack(shapes, axis=1), axis=0, return_inverse=True)
        slower = air.wind_speed_m_s / unique[:, 0]
        x = np.log(frequency) + np.log(slower)[:, None]
        scales = [None] if self.outer_scale_m is None else list(np.unique(unique[:, 1]))
        values = np.empty(x.shape)
        if len(scales) <= _FEW_SCALES:
            for scale in scales:
                rows = slice(None) if scale is None else unique[:, 1] == scale
                spline = tilt_spline(self._template(None if scale is None else float(scale)))
                values[rows] = spline(x[rows])
        else:
            self._interpolate_over_scales(x, unique[:, 1], values)
        return np.asarray((np.exp(values) * slower[:, None])[which.ravel()] * strength[:, None])

    def _template(self, outer_scale_m: float | None) -> Atmosphere:
        return replace(self.atmosphere, outer_scale_m=outer_scale_m)

    def _interpolate_over_scales(
        self, x: FloatArray, outer_scale_m: FloatArray, values: FloatArray
    ) -> None:
        """Fill in the logarithms of spectra that each have their own outer scale."""
        octave = np.floor(np.log2(outer_scale_m))
        for each in np.unique(octave):
            knots, coefficients = _octave_splines(self._template(None), int(each))
            rows = np.flatnonzero(octave == each)
            place = 2 * (np.log2(outer_scale_m[rows]) - each) - 1
            for row, terms in zip(rows, chebyshev.chebvander(place, _TERMS - 1), strict=True):
                spline = PPoly.construct_fast(coefficients @ terms, knots)
                values[row] = LogSpline(spline=spline)(x[row])


@lru_cache(maxsize=16)
def _octave_splines(air: Atmosphere, octave: int) -> tuple[FloatArray, FloatArray]:
    """Knots, and coefficients of the splines as polynomials in the logarithm of the outer scale.

    They are (4, intervals, terms), over one octave of the outer scale.
    """
    nodes = chebyshev.chebpts1(_TERMS)
    scales = 2.0 ** (octave + (nodes + 1) / 2)
    splines = [tilt_spline(replace(air, outer_scale_m=float(scale))).spline for scale in scales]
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, _TERMS - 1))
    return splines[0].x, np.stack([spline.c for spline in splines], axis=-1) @ inverse.T
