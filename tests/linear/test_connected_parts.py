"""The parts of a graph, against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from lbt_synth.linear.connected_parts import connected_parts


@pytest.mark.parametrize(("both_ways", "kind"), [(False, "weak"), (True, "strong")])
def test_parts_are_those_of_scipy(both_ways, kind):
    rng = np.random.default_rng(3)
    for _ in range(200):
        size = int(rng.integers(1, 25))
        links = (rng.random((size, size)) < 1.2 / size) * rng.standard_normal((size, size))
        own = connected_parts(links, both_ways=both_ways)
        count, other = connected_components(links != 0, connection=kind)
        assert sorted(set(own.tolist())) == list(range(count))
        np.testing.assert_array_equal(np.equal.outer(own, own), np.equal.outer(other, other))


def test_nothing_has_no_parts():
    assert connected_parts(np.zeros((0, 0))).size == 0
