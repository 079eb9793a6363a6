"""Panels of quadrature around poles."""

import numpy as np

from lbt_synth.loop.ensemble.panels import graded_edges


def test_panels_reach_the_narrowest_poles():
    pole = (1 - 1e-8) * np.exp(0.3j)
    edges = graded_edges(np.array([pole, pole.conj()]))
    inside = np.searchsorted(edges, 0.3 / np.pi)
    assert edges[inside] - edges[inside - 1] <= 2.1e-8 / np.pi
