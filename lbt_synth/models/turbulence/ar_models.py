"""Auto-regressive models of tip and tilt by turbulence, of order one and two.

AR1: B. Le Roux et al., J. Opt. Soc. Am. A 21, 1261 (2004),
doi:10.1364/JOSAA.21.001261. AR2: fitted here by the Whittle likelihood
(P. Whittle, Ark. Mat. 2, 423 (1953), doi:10.1007/BF02590998) of the measured
series, turbulence plus white noise, so that frequencies below the noise do not count.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import minimize

from lbt_synth.errors import NumericalError
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.models.ar_model import ARModel
from lbt_synth.models.resonance_spectrum import coefficients, log_density
from lbt_synth.models.turbulence.atmosphere import LOWEST, Atmosphere
from lbt_synth.models.turbulence.frozen_flows import FrozenFlows
from lbt_synth.validation import FloatArray, frozen_copy, integer, number

_PANELS = 100  # of the contrast
_FREQUENCIES, _DAMPINGS = (0.25, 0.5, 1.0), (0.01, 0.05, 0.2, 0.6)  # starts; the first in V / D
_LEAST_DAMPING = 1e-6  # less is no turbulence


def le_roux_pole(
    *, wind_speed_m_s: float, diameter_m: float, frame_rate_hz: float, radial_order: int = 1
) -> float:
    """Pole of the AR1 model, ``exp(-2 pi f_c / f_s)`` with ``f_c = 0.3 (n + 1) V / D``.

    Parameters
    ----------
    wind_speed_m_s, diameter_m, frame_rate_hz : float
        Wind speed V [m/s]; telescope diameter D [m]; sampling frequency f_s [Hz].
    radial_order : int, optional
        Radial order n of the Zernike mode; 1 for tip and tilt.

    Returns
    -------
    float
        The pole, in (0, 1).

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(lbt.models.le_roux_pole(wind_speed_m_s=20, diameter_m=8.22, frame_rate_hz=800), 5)
    0.9886
    """
    order = integer(radial_order, "radial_order", at_least=1)
    speed = number(wind_speed_m_s, "wind_speed_m_s", above=0)
    diameter = number(diameter_m, "diameter_m", above=0)
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    return float(pole(speed, diameter, rate, order))


def pole(speed: Any, diameter: float, rate: float, order: Any = 1) -> Any:
    """Pole for one or many wind speeds [m/s] or radial orders."""
    return np.exp(-2 * np.pi * 0.3 * (order + 1) * speed / diameter / rate)


def ar1_turbulence(atmosphere: Atmosphere, *, frame_rate_hz: float) -> ARModel:
    """AR1 model: Le Roux pole, stationary variance of the von Karman spectrum.

    Parameters
    ----------
    atmosphere : Atmosphere
        Turbulence and telescope.
    frame_rate_hz : float
        Sampling frequency [Hz].

    Returns
    -------
    ARModel
        Process of order 1 with ``rms_nm`` equal to ``atmosphere.tilt_rms_nm``.

    Raises
    ------
    ProblemError
        If the frame rate is not a positive number.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.Atmosphere(
    ...     seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22
    ... )
    >>> model = lbt.models.ar1_turbulence(air, frame_rate_hz=800)
    >>> round(float(model.coefficients[0]), 5), round(model.rms_nm, 1)
    (0.9886, 591.6)
    """
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    a = pole(atmosphere.wind_speed_m_s, atmosphere.diameter_m, rate)
    driving = atmosphere.tilt_rms_nm * np.sqrt(1 - a**2)
    return ARModel(coefficients=frozen_copy([a]), driving_rms_nm=driving, frame_rate_hz=rate)


def ar1_flows(flows: FrozenFlows, *, frame_rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Coefficients (p, 1) and driving noise (p,) [nm] of the AR1 models of p frozen flows."""
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    poles = pole(flows.wind_speed_m_s, flows.atmosphere.diameter_m, rate)
    return poles[:, None], flows.tilt_rms_nm * np.sqrt(1 - poles**2)


def ar2_turbulence(atmosphere: Atmosphere, *, frame_rate_hz: float, noise_nm: float) -> ARModel:
    """AR2 model fitted to the von Karman frozen-flow spectrum.

    Its rms is that of the turbulence. Its frequency and damping minimise the Whittle contrast
    ``int log(M + N) + (S + N) / (M + N) df`` over the model spectrum M; S is the turbulence and N
    the white measurement noise.

    Parameters
    ----------
    atmosphere : Atmosphere
        Turbulence and telescope.
    frame_rate_hz : float
        Sampling frequency [Hz].
    noise_nm : float
        Measurement noise per frame [nm]; it sets down to which level the
        spectrum has to be matched.

    Returns
    -------
    ARModel
        Process of order 2 with ``rms_nm`` equal to ``atmosphere.tilt_rms_nm``.

    Raises
    ------
    ProblemError
        If a value is out of its range.
    NumericalError
        If the fit does not converge.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.Atmosphere(
    ...     seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22
    ... )
    >>> model = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=15.5)
    >>> [round(float(a), 4) for a in model.coefficients]
    [1.9975, -0.9976]
    """
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    noise = number(noise_nm, "noise_nm", above=0)
    crossing_hz, rms = atmosphere.wind_speed_m_s / atmosphere.diameter_m, atmosphere.tilt_rms_nm
    frequency, weight = gauss_panels(np.geomspace(LOWEST * crossing_hz, rate / 2, _PANELS), 4)
    weight, target = weight / (rate / 2), 1 + atmosphere.psd(frequency) * rate / (2 * noise**2)
    s = 4 * np.sin(np.pi * frequency / rate) ** 2

    def contrast(p: FloatArray) -> float:
        """Take the mean of log(model / numerator), which has no narrow peaks, for log(model)."""
        angle, damping = _unpack(p, rate)
        shape, _, _ = log_density(angle, damping, s)
        numerator = coefficients(angle, damping)[2]
        model = 1 + (rms / noise) ** 2 * np.exp(shape)
        return float(np.log(numerator) + weight @ (np.log(model) - shape + target / model))

    starts = [_pack(f * crossing_hz, z) for f in _FREQUENCIES for z in _DAMPINGS]
    with np.errstate(all="ignore"):  # noise far above the turbulence leaves nothing to fit
        fit = minimize(
            contrast,
            min(starts, key=contrast),
            method="Nelder-Mead",
            options={"xatol": 1e-8, "fatol": 1e-13, "maxiter": 2000, "maxfev": 2000},
        )
    angle, damping = _unpack(fit.x, rate)
    if not (fit.success and damping > _LEAST_DAMPING):
        reason = "the noise hides the turbulence." if fit.success else str(fit.message)
        raise NumericalError(
            f"the AR2 fit to the turbulence spectrum did not converge: {reason} "
            "Try the AR1 model, or check that the noise is not above the turbulence.",
            status=str(fit.message),
        )
    a1, a2, drive = coefficients(angle, damping)
    return ARModel(
        coefficients=frozen_copy([a1, a2]), driving_rms_nm=rms * np.sqrt(drive), frame_rate_hz=rate
    )


def _pack(frequency_hz: float, damping: float) -> FloatArray:
    """Return log frequency and log damping / (1 - damping)."""
    return np.log([frequency_hz, damping / (1 - damping)])


def _unpack(p: FloatArray, rate: float) -> tuple[float, float]:
    """Return the angle per frame and the damping of packed parameters."""
    return 2 * np.pi * float(np.exp(p[0])) / rate, float(1 / (1 + np.exp(-p[1])))
