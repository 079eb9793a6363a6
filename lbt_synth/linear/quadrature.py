"""Gauss-Legendre quadrature on panels, fixed or adaptive, and panels that crowd at resonances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.validation import ComplexArray, FloatArray

_NARROWEST = 1e-10  # pole width that panels are still refined to, as a fraction of Nyquist
_HALVINGS = 45  # of panels, after which an integral does not settle: 1e-14 of their length


def gauss_panels(edges: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights (panels * order,) of a Gauss-Legendre rule on consecutive panels."""
    nodes, weights = panel_rule(edges[:-1], edges[1:], order)
    return nodes.ravel(), weights.ravel()


legendre_rule = cache(np.polynomial.legendre.leggauss)


def panel_rule(low: FloatArray, high: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights (panels, order) of panels that need not touch."""
    x, w = legendre_rule(order)
    half, middle = (high - low)[:, None] / 2, (high + low)[:, None] / 2
    return middle + half * x, half * w


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedPanels:
    """Panels on which an integral has converged, in increasing order."""

    low: FloatArray  # (panels,)
    high: FloatArray  # (panels,)
    integrals: FloatArray  # (panels, ...): integral over each panel


def _panel_integrals(
    integrand: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray, order: int
) -> FloatArray:
    """Integral over each panel, (panels, ...)."""
    nodes, weights = panel_rule(low, high, order)
    values = integrand(nodes.ravel())
    values = values.reshape(low.size, order, *values.shape[1:])
    return np.asarray(np.einsum("po,po...->p...", weights, values))


def _halve_panels(
    integrand: Callable[[FloatArray], FloatArray],
    edges: FloatArray,
    order: int,
    limits_of: Callable[[FloatArray, FloatArray], FloatArray],
) -> RefinedPanels:
    """Halve panels until changes (panels, ...) are below limits by the total and the lengths."""
    low, high = edges[:-1], edges[1:]
    coarse = _panel_integrals(integrand, low, high, order)
    settled: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    total = np.zeros(coarse.shape[1:])
    for _ in range(_HALVINGS):
        middle, count = (low + high) / 2, low.size
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
        halves = _panel_integrals(integrand, low, high, order)
        fine, lengths = halves[:count] + halves[count:], high[count:] - low[:count]
        change = np.abs(fine - coarse)
        limits = limits_of(total + np.abs(fine).sum(axis=0), lengths)
        done = np.all((change <= limits).reshape(count, -1), axis=1)
        settled.append((low[:count][done], high[count:][done], fine[done]))
        total = total + np.abs(fine[done]).sum(axis=0)
        if done.all():
            begin, end, integrals = (np.concatenate(rows) for rows in zip(*settled, strict=True))
            rank = np.argsort(begin)
            return RefinedPanels(low=begin[rank], high=end[rank], integrals=integrals[rank])
        halved = np.tile(~done, 2)
        low, high, coarse = low[halved], high[halved], halves[halved]
    raise NumericalError(
        f"the integral of a spectrum did not settle: it still changes after {_HALVINGS} halvings. "
        "Check that the spectrum is finite, without jumps and not a set of delta functions; give a "
        "table its own frequencies.",
        status="quadrature",
    )


def adaptive_integral(
    integrand: Callable[[FloatArray], FloatArray], edges: FloatArray
) -> FloatArray:
    """Integrate a semidefinite function until a panel changes by at most 1e-7 of the trace."""

    def limits(total: FloatArray, lengths: FloatArray) -> FloatArray:
        return np.asarray(1e-7 * np.trace(total, axis1=-2, axis2=-1)[..., None, None])

    return np.asarray(_halve_panels(integrand, edges, 6, limits).integrals.sum(axis=0))


def refine_panels(
    integrand: Callable[[FloatArray], FloatArray], edges: FloatArray
) -> RefinedPanels:
    """Halve panels until a panel changes by at most 1e-10, and of the first entry, of a vector."""

    def limits(total: FloatArray, lengths: FloatArray) -> FloatArray:
        return np.full((lengths.size, 1), 1e-10 * min(1.0, float(total[0])))

    return _halve_panels(integrand, edges, 10, limits)


def graded_edges(poles: ComplexArray) -> FloatArray:
    """Panels of (0, 1), as fractions of Nyquist, that are short where a pole is near.

    A panel is halved while it is longer than twice its distance from a pole, or than twice
    the width of a pole that it holds. Poles that differ by less than a quarter of their width count
    once.
    """
    upper = poles[poles.imag >= 0]
    centre = np.abs(np.angle(upper)) / np.pi
    width = np.maximum(np.abs(1 - np.abs(upper)), np.pi * _NARROWEST) / np.pi
    size = np.exp2(np.floor(np.log2(width)))
    distinct = np.unique(size + 1j * np.floor(4 * centre / size), return_index=True)[1]
    centre, width = centre[distinct], width[distinct]
    grid = np.concatenate([[0.0], np.geomspace(1e-6, 1, 24)])
    low, high = grid[:-1], grid[1:]
    done = [np.ones(1)]
    while low.size:
        outside = np.maximum(low[:, None] - centre, centre - high[:, None])
        nearest = np.min(np.maximum(outside, width), axis=1, initial=1.0)
        long = high - low > 2 * nearest
        done.append(low[~long])
        middle = (low[long] + high[long]) / 2
        low, high = np.concatenate([low[long], middle]), np.concatenate([middle, high[long]])
    return np.sort(np.concatenate(done))
