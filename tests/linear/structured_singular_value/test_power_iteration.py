"""The lower bound of a matrix: structure, singularity, and a random search."""

from __future__ import annotations

import numpy as np
import pytest
from support.blocks import random_case, random_uncertainty

from lbt_synth.linear import Block
from lbt_synth.linear.structured_singular_value.blocks import has_structure
from lbt_synth.linear.structured_singular_value.power_iteration import destabilising_delta
from lbt_synth.linear.structured_singular_value.scales import best_scales


@pytest.mark.parametrize("kinds", [("full", "complex"), ("full", "complex", "real")])
@pytest.mark.parametrize("seed", range(8))
def test_delta_is_singular_and_no_larger_than_the_bound_allows(seed, kinds):
    matrix, blocks, _ = random_case(seed, kinds)
    scales = best_scales(matrix, blocks)
    delta = destabilising_delta(matrix, blocks, scales)
    upper = scales.bound(matrix)
    if delta is None:
        assert any(each.kind == "real" for each in blocks)
        return
    assert has_structure(delta, blocks)
    loop = np.eye(len(matrix)) - matrix @ delta
    assert np.linalg.svd(loop)[1][-1] < 1e-10 * max(np.linalg.norm(loop, 2), 1)
    lower = 1 / np.linalg.norm(delta, 2)
    assert lower <= upper
    if "real" in kinds:
        return
    assert lower >= 0.95 * upper
    rng = np.random.default_rng(seed)
    for _ in range(200):
        searched = np.abs(np.linalg.eigvals(matrix @ random_uncertainty(rng, blocks))).max()
        assert searched <= upper


def test_a_loop_of_nothing_has_no_delta():
    blocks = [Block(), Block()]
    nilpotent = np.array([[0, 1.0], [0, 0]])
    assert destabilising_delta(nilpotent, blocks, best_scales(nilpotent, blocks)) is None
