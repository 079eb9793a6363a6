"""The root of a function between two numbers, and the least value on an interval.

``scipy.optimize`` has the like, and takes longer to import than most commands to compute.

T. R. Chandrupatla, "A new hybrid quadratic/bisection algorithm for finding the zero of a nonlinear
function without using derivatives", Adv. Eng. Softw. 28, 145 (1997),
doi:10.1016/S0965-9978(96)00051-8.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev

from lbt_synth.validation import FloatArray

_NODES = 9  # of a polynomial through a function around its least value


def find_root(
    function: Callable[[float], float],
    low: float,
    high: float,
    *,
    width: float,
    values: tuple[float, float] | None = None,
) -> float:
    """Return where a function changes its sign, to half the width of an interval that holds it.

    The signs of its values at both ends must differ; they may be given. The function may jump.

    Examples
    --------
    >>> from lbt_synth.linear.scalar_search import find_root
    >>> round(find_root(lambda x: x**3 - 2, 0.0, 2.0, width=1e-12), 9)
    1.25992105
    """
    a, b = low, high
    at_a, at_b = (function(a), function(b)) if values is None else values
    if np.isnan(at_a + at_b) or (at_a and at_b and (at_a > 0) == (at_b > 0)):
        raise ValueError(
            f"the signs at {low} and {high} must differ; the values are {at_a} and {at_b}"
        )
    part = 0.5
    while True:
        best, at_best = (a, at_a) if abs(at_a) < abs(at_b) else (b, at_b)
        least = max(width, 4 * np.finfo(np.float64).eps * abs(best)) / (2 * abs(b - a) or 1.0)
        if at_best == 0 or a == b or least > 0.5:
            return best
        x = a + float(np.clip(part, least, 1 - least)) * (b - a)
        at_x = function(x)
        if np.isnan(at_x):
            raise ValueError(f"the function has no value at {x}")
        if (at_x > 0) == (at_a > 0):
            c, at_c = a, at_a
        else:
            c, at_c, b, at_b = b, at_b, a, at_a
        a, at_a = x, at_x
        place, slope = (a - b) / (c - b), (at_a - at_b) / (at_c - at_b)
        part = 0.5
        if (
            slope * slope < place and (1 - slope) * (1 - slope) < 1 - place
        ):  # the inverse parabola is safe
            part = at_a / (at_b - at_a) * at_c / (at_b - at_c)
            part += (c - a) / (b - a) * at_a / (at_c - at_a) * at_b / (at_c - at_b)


def find_least(
    function: Callable[[FloatArray], FloatArray], low: float, high: float, *, width: float
) -> tuple[float, float]:
    """Return where a function of many numbers (k,) is least between two, to a width, and its value.

    It has one minimum there and is smooth around it; elsewhere it may be infinite. Each step
    takes its values at k numbers, and the least of the polynomial through them.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.scalar_search import find_least
    >>> place, least = find_least(np.cosh, -1.0, 3.0, width=1e-6)
    >>> round(place, 5) + 0.0, round(least, 9)
    (0.0, 1.0)
    """
    nodes = chebyshev.chebpts2(_NODES)
    to_terms = np.linalg.inv(chebyshev.chebvander(nodes, _NODES - 1))
    first, last, before = low, high, np.inf
    while True:
        middle, half = (first + last) / 2, (last - first) / 2
        x = np.clip(middle + half * nodes, low, high)
        values = function(x)
        i = int(np.argmin(values))
        first, last = float(x[max(i - 1, 0)]), float(x[min(i + 1, _NODES - 1)])
        best, least = float(x[i]), float(values[i])
        if np.all(np.isfinite(values)):
            terms = to_terms @ (values - values[i])
            turns = chebyshev.chebroots(chebyshev.chebder(terms))
            places = middle + half * turns.real[turns.imag == 0]
            places = places[(first < places) & (places < last)]
            if places.size:
                sizes = chebyshev.chebval((places - middle) / half, terms)
                best, least = float(places[np.argmin(sizes)]), least + float(np.min(sizes))
        if abs(best - before) <= width or last - first <= width:
            return best, least
        before = best
