"""Auto-regressive models of turbulence: tip and tilt of order one and two, modes of order one.

AR1: B. Le Roux et al., J. Opt. Soc. Am. A 21, 1261 (2004),
doi:10.1364/JOSAA.21.001261. AR2: fitted here by the Whittle likelihood
(P. Whittle, Ark. Mat. 2, 423 (1953), doi:10.1007/BF02590998) of the measured
series, turbulence plus white noise, so that frequencies below the noise do not count.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import jv

from lbt_synth.errors import NumericalError
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.models.resonance_spectrum import coefficient_rows, drive_ratio, unit_densities
from lbt_synth.models.spectra import ARModel
from lbt_synth.models.turbulence.atmosphere import LOWEST, Atmosphere, kolmogorov_constant_nm2
from lbt_synth.validation import (
    FloatArray,
    IntArray,
    frozen_copy,
    integer,
    number,
    read_only,
    require_instance,
)

_PANELS = 100  # of the contrast
_FREQUENCIES, _DAMPINGS = (0.25, 0.5, 1.0), (0.01, 0.05, 0.2, 0.6)  # starts; the first in V / D
_LEAST_DAMPING = 1e-6  # less is no turbulence
_FURTHEST = 30  # the tail of the integral begins at this multiple of the order plus 2


def pole(speed: Any, diameter: float, rate: float, order: Any = 1) -> Any:
    """Pole of AR1 models, with the cut-off at 0.3 (n + 1) V / D, for wind speeds V or orders n."""
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
        shape = np.log(unit_densities([angle], [damping], s, [1])[0])
        numerator = drive_ratio(angle, damping)
        model = 1 + (rms / noise) ** 2 * np.exp(shape)
        return float(np.log(numerator) + weight @ (np.log(model) - shape + target / model))

    starts = [np.log([f * crossing_hz, z / (1 - z)]) for f in _FREQUENCIES for z in _DAMPINGS]
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
    return ARModel(
        coefficients=coefficient_rows(np.array(angle), np.array(damping)),
        driving_rms_nm=rms * np.sqrt(drive_ratio(angle, damping)),
        frame_rate_hz=rate,
    )


def _unpack(p: FloatArray, rate: float) -> tuple[float, float]:
    """Return angle per frame and damping, from log frequency and log damping / (1 - damping)."""
    return 2 * np.pi * float(np.exp(p[0])) / rate, float(1 / (1 + np.exp(-p[1])))


def radial_orders(modes: int) -> IntArray:
    """Radial orders (modes,) of the first Zernike modes after piston, in Noll's order."""
    count = integer(modes, "modes", at_least=1)
    orders = np.arange(1, int(np.sqrt(2 * count)) + 1)  # of which n has n + 1 modes
    return read_only(np.repeat(orders, orders + 1)[:count])


@lru_cache(maxsize=32)
def zernike_variances(atmosphere: Atmosphere, highest: int) -> FloatArray:
    """Variance of a Zernike mode of each radial order 1 to ``highest``, (highest,) [nm^2].

    They are the same for all azimuthal orders, on a disc without obstruction::

        2 pi (n + 1) int 0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6) (2 J_n+1(pi D f) / (pi D f))^2 f df
    """
    top = integer(highest, "highest", at_least=1)
    inner = 0.0 if atmosphere.outer_scale_m is None else atmosphere.outer_scale_m**-2
    per_x = np.pi * atmosphere.diameter_m  # x = pi D f
    out = np.empty(top)
    for n in range(1, top + 1):
        # octaves before anything oscillates, then half periods of the squared Bessel function
        end = _FURTHEST * (n + 2)
        edges = np.concatenate([np.geomspace(1e-24, 0.5, 160), np.arange(1.0, end, np.pi / 2)])
        x, w = gauss_panels(edges, 8)
        spectrum = ((x / per_x) ** 2 + inner) ** (-11 / 6)
        integral = float(np.sum(w * spectrum * jv(n + 1, x) ** 2 / x))
        # in the tail J^2 is 1 / (pi x) on average, and the outer scale does not matter
        integral += per_x ** (11 / 3) * edges[-1] ** (-14 / 3) * 3 / (14 * np.pi)
        out[n - 1] = 8 * np.pi * (n + 1) / per_x**2 * integral
    return frozen_copy(kolmogorov_constant_nm2(atmosphere) * out)


def modal_turbulence(atmosphere: Atmosphere, *, modes: int, frame_rate_hz: float) -> ARModel:
    """AR1 models of the first Zernike modes after piston, in Noll's order.

    Each has the variance of von Karman turbulence on a disc and the pole of Le Roux et al.,
    ``exp(-2 pi 0.3 (n + 1) V / (D f_s))`` with the radial order n: the cut-off frequency of the
    mode is right, the shape of its spectrum is not (that of frozen flow falls with the power
    -17/3, that of AR1 with -2), and what modes of one azimuthal order have in common is left out.
    B. Le Roux et al., J. Opt. Soc. Am. A 21, 1261 (2004), doi:10.1364/JOSAA.21.001261. Modes of
    a mirror that are sorted like Zernike modes (Karhunen-Loeve modes) have nearly these variances.

    Parameters
    ----------
    atmosphere : Atmosphere
        Turbulence and telescope; an obstruction plays no part.
    modes : int
        Number of modes, tip and tilt first.
    frame_rate_hz : float
        Sampling frequency [Hz].

    Returns
    -------
    ARModel
        A stack of processes of order 1; mode i has Noll's number i + 2.

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.Atmosphere(
    ...     seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22
    ... )
    >>> modes = lbt.models.modal_turbulence(air, modes=672, frame_rate_hz=800)
    >>> modes.rms_nm[[0, 2, 671]].round(1).tolist()
    [591.6, 308.8, 3.0]
    >>> modes.coefficients[[0, 2, 671], 0].round(4).tolist()
    [0.9886, 0.9829, 0.8089]
    """
    require_instance(atmosphere, Atmosphere)
    radial = radial_orders(modes)
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    poles = pole(atmosphere.wind_speed_m_s, atmosphere.diameter_m, rate, radial)
    variances = zernike_variances(atmosphere, int(radial[-1]))[radial - 1]
    return ARModel(
        coefficients=poles[:, None],
        driving_rms_nm=np.sqrt(variances * (1 - poles**2)),
        frame_rate_hz=frame_rate_hz,
    )
