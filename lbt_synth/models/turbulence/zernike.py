"""Zernike modes in Noll's order, and their variances in von Karman turbulence.

R. J. Noll, J. Opt. Soc. Am. 66, 207 (1976), doi:10.1364/JOSA.66.000207.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import jv

from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.models.turbulence.atmosphere import Atmosphere, kolmogorov_constant_nm2
from lbt_synth.validation import FloatArray, IntArray, frozen_copy, integer, read_only

_FURTHEST = 30  # the tail of the integral begins at this multiple of the order plus 2


def noll_orders(modes: int) -> tuple[IntArray, IntArray]:
    """Radial and azimuthal orders (modes,) of the first Zernike modes after piston.

    They are in Noll's order, j = 2 to ``modes + 1``; the azimuthal order is not negative.
    """
    count = integer(modes, "modes", at_least=1)
    radial: list[int] = []
    azimuthal: list[int] = []
    n = 0
    while len(radial) < count:
        n += 1
        for m in range(n % 2, n + 1, 2):
            twice = 1 if m == 0 else 2
            radial += [n] * twice
            azimuthal += [m] * twice
    return read_only(np.array(radial[:count])), read_only(np.array(azimuthal[:count]))


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
