"""Zernike modes in turbulence: orders, variances, AR1 models."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma, jv

import lbt_synth as lbt
from lbt_synth.models.turbulence.zernike import noll_orders, zernike_variances

SITE = {"seeing_arcsec": 0.8, "wind_speed_m_s": 20, "diameter_m": 8.22}


def kolmogorov(air: lbt.Atmosphere, n: int) -> float:
    """Closed form, Noll (1976) eq. 25 with all digits of its constant [nm^2]."""
    power, order = 14 / 3, n + 1
    bessel = gamma(power) * gamma(order + (1 - power) / 2)
    bessel /= 2**power * gamma((1 + power) / 2) ** 2 * gamma(order + (1 + power) / 2)
    ratio = air.diameter_m / air.fried_parameter_m
    radians = 8 * np.pi * (n + 1) * 0.0228956 * (np.pi * ratio) ** (5 / 3) * bessel
    return float(radians * (air.seeing_wavelength_um * 1e3 / (2 * np.pi)) ** 2)


def test_variances_are_nolls_closed_form():
    air = lbt.Atmosphere(outer_scale_m=None, **SITE)
    found = zernike_variances(air, 36)
    expected = [kolmogorov(air, n) for n in range(1, 37)]
    assert np.allclose(found, expected, rtol=1e-6)
    # Noll's table IV: a tilt has 0.448 (D/r0)^(5/3) rad^2, a defocus 0.0232
    unit = (air.diameter_m / air.fried_parameter_m) ** (5 / 3) * (500 / (2 * np.pi)) ** 2
    assert np.allclose(found[:2] / unit, [0.448, 0.0232], rtol=3e-3)


def test_variances_with_an_outer_scale():
    air = lbt.Atmosphere(outer_scale_m=22, **SITE)
    found = zernike_variances(air, 36)
    assert found[0] == pytest.approx(air.tilt_rms_nm**2, rel=1e-7)
    scale = kolmogorov(air, 5) / kolmogorov_integral(air, 5, None)
    assert found[4] == pytest.approx(scale * kolmogorov_integral(air, 5, 22.0), rel=1e-5)
    assert np.all(np.diff(found) < 0)


def kolmogorov_integral(air, n, outer):
    inner = 0 if outer is None else outer**-2

    def density(x):
        f = x / (np.pi * air.diameter_m)
        return f * (f**2 + inner) ** (-11 / 6) * (jv(n + 1, x) / x) ** 2

    return (
        sum(quad(density, a, a + 5, epsabs=0, epsrel=1e-9)[0] for a in range(1, 300, 5))
        + quad(density, 1e-6, 1, epsrel=1e-9)[0]
    )


def test_nolls_order():
    radial, azimuthal = noll_orders(20)
    # Noll's table I, j = 2 to 21
    assert radial.tolist() == [1] * 2 + [2] * 3 + [3] * 4 + [4] * 5 + [5] * 6
    assert azimuthal.tolist() == [1, 1, 0, 2, 2, 1, 1, 3, 3, 0, 2, 2, 4, 4, 1, 1, 3, 3, 5, 5]
    with pytest.raises(lbt.errors.ProblemError, match="modes must be at least 1"):
        noll_orders(0)
