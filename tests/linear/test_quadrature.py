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
    widths = np.array([1e-4, 1e-2])

    def peaks(x):
        return (1e-3 * widths / (widths**2 + (x[:, None] - 0.3) ** 2))[..., None, None]

    integrals = adaptive_integral(peaks, np.array([0.0, 1.0]))[:, 0, 0]
    expected = 1e-3 * (np.arctan(0.7 / widths) + np.arctan(0.3 / widths))
    assert integrals == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-8])
def test_a_peak_upon_much_that_is_flat(distance):
    """Of poles next to the unit circle, by Poisson's kernel; a part of 0.002 of the whole."""
    radius, turns = 1 - distance, np.array([0.7, -0.7])

    def density(x):
        below = distance**2 + 4 * radius * np.sin((np.pi * x[:, None] - turns) / 2) ** 2
        return (1000 + np.sum((1 - radius**2) / below, axis=1))[:, None, None]

    integral = adaptive_integral(density, graded_edges(radius * np.exp(1j * turns)))
    assert integral[0, 0] == pytest.approx(1002, rel=3e-7)


def test_panels_are_short_where_a_pole_is_near():
    turn = np.exp(0.3j * np.array([1, -1]))
    for poles, shortest in (
        ([*0.999 * turn, 1 - 1e-5, 0.2], 2 * 0.001),
        ((1 - 1e-8) * turn, 2.1e-8),
    ):
        edges = graded_edges(np.array(poles))
        assert (edges[0], edges[-1]) == (0, 1)
        assert np.all(np.diff(edges) > 0)
        inside = np.searchsorted(edges, 0.3 / np.pi)
        assert edges[inside] - edges[inside - 1] <= shortest / np.pi
        assert edges.size < 100
