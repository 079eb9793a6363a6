"""Panels that crowd at resonances."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.linear.panel_edges import distinct_edges, pole_edges
from lbt_synth.linear.quadrature import adaptive_integral


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
    edges = np.concatenate([[0.0], np.geomspace(1e-6, 1, 40), pole_edges(poles)])
    found = adaptive_integral(density, distinct_edges(edges))
    assert found[0, 0] == pytest.approx(1002, rel=3e-7)
