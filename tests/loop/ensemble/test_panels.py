"""Panels of quadrature around poles."""

import numpy as np

from lbt_synth.loop.ensemble.panels import graded_edges


def test_panels_reach_the_narrowest_poles():
    pole = (1 - 1e-8) * np.exp(0.3j)
    edges = graded_edges(np.array([pole, pole.conj()]))
    inside = np.searchsorted(edges, 0.3 / np.pi)
    assert edges[inside] - edges[inside - 1] <= 2.1e-8 / np.pi


def test_panels_are_short_where_a_pole_is_near():
    poles = np.array([0.999 * np.exp(0.3j), 0.999 * np.exp(-0.3j), 1 - 1e-5, 0.2])
    edges = graded_edges(poles)
    assert edges[0] == 0
    assert edges[-1] == 1
    assert np.all(np.diff(edges) > 0)
    inside = np.searchsorted(edges, 0.3 / np.pi)
    assert edges[inside] - edges[inside - 1] <= 2 * 0.001 / np.pi
    assert edges.size < 100
