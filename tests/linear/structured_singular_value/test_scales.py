"""The upper bound of a matrix, against SLICOT's AB13MD and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import slycot
from support.blocks import random_case

from lbt_synth.linear import Block
from lbt_synth.linear.structured_singular_value.scales import best_scales


@pytest.mark.parametrize("kinds", [("full",), ("full", "complex", "real")])
@pytest.mark.parametrize("seed", range(10))
def test_never_above_slicot(seed, kinds):
    matrix, blocks, (sizes, types) = random_case(seed, kinds)
    found = best_scales(matrix, blocks).bound(matrix)
    assert found <= slycot.ab13md(matrix, sizes, types)[0] * (1 + 1e-6) + 1e-6


def test_one_full_block_is_the_norm_and_one_number_the_spectral_radius():
    matrix = np.array([[1, 5], [0.5, 2j]])
    full, number = ([Block(size=2, kind=kind)] for kind in ("full", "complex"))
    assert best_scales(matrix, full).bound(matrix) == pytest.approx(np.linalg.norm(matrix, 2))
    radius = np.abs(np.linalg.eigvals(matrix)).max()
    assert best_scales(matrix, number).bound(matrix) == pytest.approx(radius, rel=1e-5)


def test_a_level_leaves_room_for_the_scales():
    matrix, blocks, _ = random_case(0, ("full",))
    least = best_scales(matrix, blocks).bound(matrix)
    assert least < best_scales(matrix, blocks, 1.2 * least).bound(matrix) < 1.2 * least


def test_nothing_has_no_bound():
    assert best_scales(np.zeros((2, 2)), [Block(), Block()]).bound(np.zeros((2, 2))) == 0
