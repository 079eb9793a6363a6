"""Panels of quadrature around poles, and partial fractions, also of systems that have none."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear.state_space import pointwise_response
from lbt_synth.loop.ensemble.spectral_covariances import batched_response, graded_edges


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


def test_partial_fractions_and_what_has_none():
    rng = np.random.default_rng(8)
    A = rng.standard_normal((3, 4, 4)) / 3
    A[1] = np.eye(4, k=-1)  # a chain of delays: defective
    B, C, D = rng.standard_normal((3, 4, 2)), rng.standard_normal((3, 1, 4)), np.ones((3, 1, 2))
    z = np.exp(1j * np.linspace(0.01, 3, 50))
    found = batched_response(A, B, C, D, z)
    for k in range(3):
        system = lbt.linear.StateSpace(A=A[k], B=B[k], C=C[k], D=D[k])
        assert found[k] == pytest.approx(pointwise_response(system, z), rel=1e-9, abs=1e-9)
