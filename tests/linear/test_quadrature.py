"""Integrals that the panels cannot settle, and panels that crowd at resonances."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear.quadrature import adaptive_integral, graded_edges, refine_panels


def test_integrals_that_do_not_settle():
    with pytest.raises(lbt.errors.NumericalError, match="did not settle"):
        refine_panels(lambda x: (1 / x)[:, None], np.array([0.0, 1.0]))


def test_integrals_of_stacks():
    """Each member gets its own accuracy, though the panels are shared."""

    def peaks(x):
        widths = np.array([1e-4, 1e-2])
        return (1e-3 * widths / (widths**2 + (x[:, None] - 0.3) ** 2))[..., None, None]

    found = adaptive_integral(peaks, np.array([0.0, 1.0]))
    widths = np.array([1e-4, 1e-2])
    expected = 1e-3 * (np.arctan(0.7 / widths) + np.arctan(0.3 / widths))
    assert found[:, 0, 0] == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-8])
def test_a_peak_upon_much_that_is_flat(distance):
    """Of poles next to the unit circle, by Poisson's kernel; a part of 0.002 of the whole."""
    radius, turn = 1 - distance, 0.7

    def kernel(x):
        below = distance**2 + 4 * radius * np.sin(x / 2) ** 2
        return (1 - radius**2) / below

    def density(x):
        peak = kernel(np.pi * x - turn) + kernel(np.pi * x + turn)
        return (1000 + peak)[:, None, None]

    poles = radius * np.exp(1j * np.array([turn, -turn]))
    found = adaptive_integral(density, graded_edges(poles))
    assert found[0, 0] == pytest.approx(1002, rel=3e-7)


def test_panels_are_short_where_a_pole_is_near():
    poles = np.array([0.999 * np.exp(0.3j), 0.999 * np.exp(-0.3j), 1 - 1e-5, 0.2])
    edges = graded_edges(poles)
    assert edges[0] == 0
    assert edges[-1] == 1
    assert np.all(np.diff(edges) > 0)
    inside = np.searchsorted(edges, 0.3 / np.pi)
    assert edges[inside] - edges[inside - 1] <= 2 * 0.001 / np.pi
    assert edges.size < 100
    narrow = (1 - 1e-8) * np.exp(0.3j)
    edges = graded_edges(np.array([narrow, narrow.conj()]))
    inside = np.searchsorted(edges, 0.3 / np.pi)
    assert edges[inside] - edges[inside - 1] <= 2.1e-8 / np.pi
