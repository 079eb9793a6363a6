"""A cubic spline through points, smooth to the third derivative at the knots next to its ends.

``scipy.interpolate`` has the same, and is slow to import.

C. de Boor, "A Practical Guide to Splines", Springer (1978), chapter IV ("not-a-knot").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded

from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CubicSpline:
    """Cubic polynomials between knots.

    Attributes
    ----------
    knots : (k,) ndarray
        Where the polynomials meet, increasing.
    coefficients : (4, k - 1, ...) ndarray
        Of the powers 3, 2, 1 and 0 of the distance from the knot below.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.cubic_spline import cubic_spline
    >>> x = np.array([0.0, 1.0, 3.0, 4.0, 6.0])
    >>> float(cubic_spline(x, x**3)(np.array([5.0]))[0].round(9))
    125.0
    """

    knots: FloatArray
    coefficients: FloatArray

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the values of one curve; the polynomials at the ends go on beyond them."""
        piece = np.searchsorted(self.knots[1:-1], x, side="right")
        distance = x - self.knots[piece]
        cubic, square, slope, value = self.coefficients[:, piece]
        return np.asarray(((cubic * distance + square) * distance + slope) * distance + value)


def cubic_spline(x: FloatArray, y: FloatArray) -> CubicSpline:
    """Return the spline through at least four points, x (k,) increasing, of curves y (k, ...)."""
    if x.size < 4:
        raise ValueError(f"a spline needs at least four points; got {x.size}")
    step = np.diff(x)
    bands, right = np.zeros((3, x.size)), np.zeros(y.shape)
    bands[0, 2:], bands[2, :-2] = step[:-1], step[1:]
    bands[1, 1:-1] = 2 * (step[:-1] + step[1:])
    step = step.reshape(-1, *(1,) * (y.ndim - 1))
    slope = np.diff(y, axis=0) / step
    right[1:-1] = 3 * (step[1:] * slope[:-1] + step[:-1] * slope[1:])
    for end, beside, way in ((0, 1, 1), (-1, -2, -1)):
        h, g = step[end], step[beside]
        bands[1, end], bands[1 - way, beside] = g.item(), (h + g).item()
        right[end] = ((3 * h + 2 * g) * g * slope[end] + h**2 * slope[beside]) / (h + g)
    tangent = solve_banded((1, 1), bands, right.reshape(x.size, -1)).reshape(y.shape)
    bend = (tangent[:-1] + tangent[1:] - 2 * slope) / step
    parts = (bend / step, (slope - tangent[:-1]) / step - bend, tangent[:-1], y[:-1])
    return CubicSpline(knots=x, coefficients=np.stack(parts))
