"""Gauss-Legendre quadrature on panels, fixed or adaptive, and panels that crowd at resonances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, frozen_copy

_NARROWEST = 1e-10  # pole width that panels are still refined to, as a fraction of Nyquist
_PANEL = 2.0  # length of a panel over its distance from a pole, or over the pole's width


def gauss_panels(edges: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights (panels * order,) of a Gauss-Legendre rule on consecutive panels."""
    nodes, weights = panel_rule(edges[:-1], edges[1:], order)
    return nodes.ravel(), weights.ravel()


_legendre_rule = cache(np.polynomial.legendre.leggauss)


def panel_rule(low: FloatArray, high: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights (panels, order) of panels that need not touch."""
    x, w = _legendre_rule(order)
    half, middle = (high - low)[:, None] / 2, (high + low)[:, None] / 2
    return middle + half * x, half * w


def _panel_integrals(
    integrand: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray, order: int
) -> FloatArray:
    """Integral over each panel, (panels, ...)."""
    nodes, weights = panel_rule(low, high, order)
    values = integrand(nodes.ravel())
    values = values.reshape(low.size, order, *values.shape[1:])
    return np.asarray(np.einsum("po,po...->p...", weights, values))


def _halves(
    integrand: Callable[[FloatArray], FloatArray],
    low: FloatArray,
    middle: FloatArray,
    high: FloatArray,
    order: int,
) -> tuple[FloatArray, FloatArray]:
    """Integrals over the lower and upper halves of panels, (panels, ...) each, in one call."""
    both = _panel_integrals(
        integrand, np.concatenate([low, middle]), np.concatenate([middle, high]), order
    )
    return both[: low.size], both[low.size :]


def _stack(left: FloatArray, right: FloatArray, rows: BoolArray) -> FloatArray:
    """Chosen rows of two arrays, one below the other."""
    return np.concatenate([left[rows], right[rows]])


def adaptive_integral(
    integrand: Callable[[FloatArray], FloatArray], edges: FloatArray
) -> FloatArray:
    """Integrate a matrix-valued function, halving panels until its trace converges to 1e-7."""
    low, high = edges[:-1], edges[1:]
    coarse = _panel_integrals(integrand, low, high, 6)
    done = np.zeros(coarse.shape[1:])
    for _ in range(40):
        middle = (low + high) / 2
        left, right = _halves(integrand, low, middle, high, 6)
        fine = left + right
        total = np.trace(done + fine.sum(axis=0), axis1=-2, axis2=-1)
        change = np.abs(np.trace(fine - coarse, axis1=-2, axis2=-1))
        open_ = np.any((change > 1e-7 * total).reshape(low.size, -1), axis=1)
        done = done + fine[~open_].sum(axis=0)
        if not open_.any():
            return np.asarray(done)
        low, high = _stack(low, middle, open_), _stack(middle, high, open_)
        coarse = _stack(left, right, open_)
    raise NumericalError(
        "the integral of a spectrum did not settle: it still changes after 40 halvings. "
        "Check that the spectrum is finite and not a set of delta functions.",
        status="quadrature",
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedPanels:
    """Panels on which a vector-valued integral has converged, in increasing order."""

    low: FloatArray  # (panels,)
    high: FloatArray  # (panels,)
    integrals: FloatArray  # (panels, k): integral over each panel
    change: float  # by the last halvings: summed over the panels, the largest of the k entries


def refine_panels(
    integrand: Callable[[FloatArray], FloatArray], edges: FloatArray, *, floor: float = 0.0
) -> RefinedPanels:
    """Halve panels until the integral of a vector of either sign converges to 1e-10."""

    def with_size(x: FloatArray) -> FloatArray:
        values = integrand(x)
        return np.concatenate([values, np.abs(values[:, :1])], axis=1)

    low, high = edges[:-1], edges[1:]
    coarse = _panel_integrals(with_size, low, high, 10)
    done: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    done_size = moved = 0.0
    for _ in range(45):
        middle = (low + high) / 2
        left, right = _halves(with_size, low, middle, high, 10)
        fine = left + right
        scale = min(1.0, done_size + float(fine[:, -1].sum()))
        change = np.max(np.abs(fine - coarse)[:, :-1], axis=1)
        open_ = change > np.maximum(1e-10 * scale, floor * (high - low))
        done.append((low[~open_], high[~open_], fine[~open_, :-1]))
        done_size += float(fine[~open_, -1].sum())
        moved += float(change[~open_].sum())
        if not open_.any():
            begin, end, integrals = (np.concatenate(parts) for parts in zip(*done, strict=True))
            rank = np.argsort(begin)
            return RefinedPanels(
                low=begin[rank], high=end[rank], integrals=integrals[rank], change=moved
            )
        low, high = _stack(low, middle, open_), _stack(middle, high, open_)
        coarse = _stack(left, right, open_)
    raise NumericalError(
        "the integral of a spectrum's logarithm did not settle: it still changes after 45 "
        "halvings. Check that the spectrum is finite and without jumps; give a table its own "
        "frequencies.",
        status="quadrature",
    )


def panel_edges(poles: ComplexArray, frame_rate_hz: float) -> FloatArray:
    """Panels of (0, Nyquist) [Hz]: geometric, and more of them around each pole."""
    edges = [np.geomspace(1e-6, 1, 40), np.array([0.0]), pole_edges(poles)]
    return frozen_copy(distinct_edges(np.concatenate(edges)) * (frame_rate_hz / 2))


def graded_edges(poles: ComplexArray) -> FloatArray:
    """Panels of (0, 1), as fractions of Nyquist, that are short where a pole is near.

    A panel is halved while it is longer than twice its distance from a pole, or than twice
    the width of a pole that it holds. Poles that differ by less than a quarter of their width count
    once.
    """
    upper = poles[poles.imag >= 0]
    centre = np.abs(np.angle(upper)) / np.pi
    width = np.maximum(1 - np.abs(upper), np.pi * _NARROWEST) / np.pi
    size = np.exp2(np.floor(np.log2(width)))
    distinct = np.unique(size + 1j * np.floor(4 * centre / size), return_index=True)[1]
    centre, width = centre[distinct], width[distinct]
    grid = np.concatenate([[0.0], np.geomspace(1e-6, 1, 24)])
    low, high = grid[:-1], grid[1:]
    done = [np.ones(1)]
    while low.size:
        outside = np.maximum(low[:, None] - centre, centre - high[:, None])
        nearest = np.min(np.maximum(outside, width), axis=1, initial=1.0)
        long = high - low > _PANEL * nearest
        done.append(low[~long])
        middle = (low[long] + high[long]) / 2
        low, high = np.concatenate([low[long], middle]), np.concatenate([middle, high[long]])
    return np.sort(np.concatenate(done))


def pole_edges(poles: ComplexArray) -> FloatArray:
    """Edges of panels around sharp poles, in units of the Nyquist frequency, unsorted.

    The panels widen with the distance from the pole until other panels are as fine. A flank of a
    narrow peak must not lie in one long panel: the nodes of its halves would miss it, too.
    """
    edges = [np.zeros(0)]
    for pole in np.ravel(poles):
        centre, width = abs(np.angle(pole)) / np.pi, max(1 - abs(pole), 1e-9) / np.pi
        if width < 0.1:
            steps = max(3, 1 + int(np.log(0.3 / width) / np.log(4)))
            offsets = np.concatenate([[0.0], width * 4.0 ** np.arange(steps)])
            edges += [centre + offsets, centre - offsets]
    return np.concatenate(edges)


def distinct_edges(edges: FloatArray) -> FloatArray:
    """Sort edges into (0, 1), and drop those that coincide."""
    grid = np.unique(np.clip(edges, 0, 1))
    return np.asarray(grid[np.concatenate([[True], np.diff(grid) > 1e-12])])
