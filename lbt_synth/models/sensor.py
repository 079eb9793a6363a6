"""Measurement noise of a modulated pyramid sensor; milliarcseconds and nanometres of tilt."""

from __future__ import annotations

import numpy as np

from lbt_synth.models.turbulence.ar_models import radial_orders
from lbt_synth.models.turbulence.atmosphere import ARCSEC_RAD
from lbt_synth.validation import FloatArray, frozen_copy, number, one_or_each


def nm_per_mas(diameter_m: float) -> float:
    """Root-mean-square wavefront of one milliarcsecond of tilt over a disc [nm].

    A tilt by theta has the Noll coefficient ``theta D / 4``.

    Parameters
    ----------
    diameter_m : float
        Telescope diameter [m].

    Returns
    -------
    float
        Nanometres of wavefront, rms over the pupil, per milliarcsecond.

    Raises
    ------
    ProblemError
        If the diameter is not a positive, finite number.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(lbt.models.nm_per_mas(8.22), 3)
    9.963
    """
    diameter = number(diameter_m, "diameter_m", above=0)
    return diameter / 4 * ARCSEC_RAD * 1e-3 * 1e9


def illuminated_subapertures(across: float, obstruction: float = 0.0) -> float:
    """Return how many subapertures of a square grid lie inside an annular pupil, on average."""
    n = number(across, "across", at_least=1)
    eps = number(obstruction, "obstruction", at_least=0, below=1)
    return float(np.pi / 4 * (1 - eps**2) * n**2)


def pyramid_tilt_noise_nm(
    *,
    photons: float | FloatArray,
    read_noise_electrons: float | FloatArray,
    modulation_lambda_over_d: float | FloatArray,
    subapertures: float,
    wavelength_um: float,
    diameter_m: float,
) -> float | FloatArray:
    """Compute the noise of the tip (or tilt) measurement, per frame [nm rms wavefront].

    Slope variance of a quad cell in one subaperture,
    ``(N + 4 s^2) / N^2`` for N photons and read noise s, propagated to the tilt
    over all subapertures through the sensitivity of a pyramid that is modulated
    by alpha: ``(pi alpha / 2) sqrt(variance / subapertures)``, at unit optical
    gain.

    Parameters
    ----------
    photons, read_noise_electrons, modulation_lambda_over_d : float or (b,) array_like
        Photons per subaperture and frame; read noise [electrons rms per pixel]; modulation radius
        [lambda/D].
    subapertures, wavelength_um, diameter_m : float
        Number of illuminated subapertures; sensing wavelength [um]; telescope diameter [m].

    Returns
    -------
    float or (b,) ndarray
        Noise [nm rms wavefront].

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(
    ...     lbt.models.pyramid_tilt_noise_nm(
    ...         photons=50,
    ...         read_noise_electrons=8,
    ...         modulation_lambda_over_d=4,
    ...         subapertures=704,
    ...         wavelength_um=0.75,
    ...         diameter_m=8.22,
    ...     ),
    ...     1,
    ... )
    15.5
    """
    n = one_or_each(photons, "photons", above=0)
    read = one_or_each(read_noise_electrons, "read_noise_electrons", at_least=0)
    modulation = one_or_each(modulation_lambda_over_d, "modulation_lambda_over_d", above=0)
    count = number(subapertures, "subapertures", above=0)
    wavelength = number(wavelength_um, "wavelength_um", above=0)
    diameter = number(diameter_m, "diameter_m", above=0)
    slope_variance = (n + 4 * read**2) / n**2
    mas = np.degrees(wavelength * 1e-6 / diameter) * 3600e3  # lambda / D
    noise_mas = np.pi * modulation * mas / 2 * np.sqrt(slope_variance / count)
    noise_nm = noise_mas * nm_per_mas(diameter)
    return noise_nm if np.ndim(noise_nm) else float(noise_nm)


def pyramid_modal_noise_nm(
    tilt_noise_nm: float, *, modes: int, modulation_lambda_over_d: float
) -> FloatArray:
    """Assume a noise for each Zernike mode of a pyramid from that of its tilt [nm rms wavefront].

    A modulated pyramid measures slopes at spatial frequencies below its modulation and phase
    above. A mode of radial order n has about ``(n + 1) / 2`` periods over the pupil, so its
    noise is taken as that of the tilt times ``2 / (n + 1)``, and not less than one over the
    modulation. This is a convenient model; the rows of the inverse of a measured interaction
    matrix give the noise of its modes.

    Parameters
    ----------
    tilt_noise_nm : float
        Noise of tip, and of tilt, per frame [nm].
    modes : int
        Number of modes, in Noll's order after piston.
    modulation_lambda_over_d : float
        Modulation radius [lambda/D].

    Returns
    -------
    (modes,) ndarray
        Noise of each mode [nm].

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> noise = lbt.models.pyramid_modal_noise_nm(15.5, modes=100, modulation_lambda_over_d=4)
    >>> noise[[0, 2, 5, 99]].round(2).tolist()
    [15.5, 10.33, 7.75, 3.88]
    """
    tilt = number(tilt_noise_nm, "tilt_noise_nm", above=0)
    modulation = number(modulation_lambda_over_d, "modulation_lambda_over_d", above=0)
    radial = radial_orders(modes)
    return frozen_copy(tilt * np.maximum(2 / (radial + 1), 1 / max(modulation, 1.0)))
