"""Families of matrices, and how they fall into blocks."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear.moving_parameter.family import ParameterFamily, split_blocks


def _two_axes(coupling):
    rng = np.random.default_rng(2)
    A0, A1 = np.zeros((2, 6, 6))
    for part in (slice(3), slice(3, 6)):
        A0[part, part] = 0.3 * rng.standard_normal((3, 3))
        A1[part, part] = 0.1 * np.outer(rng.standard_normal(3), rng.standard_normal(3))
    A0[0, 4] = coupling
    return ParameterFamily.affine(A0, A1, low=0.5, high=2.0)


def test_interpolation_between_three_knots():
    knots, matrices = np.array([1.0, 2.0, 4.0]), np.array([[[[1.0]], [[3.0]], [[0.0]]]])
    family = ParameterFamily(knots=knots, matrices=matrices)
    assert family.at(np.array([1.0, 1.5, 2.0, 3.0, 4.0])).ravel().tolist() == [1, 2, 3, 1.5, 0]


@pytest.mark.parametrize("knots", [[1.0], [2.0, 1.0], [1.0, 2.0, 3.0]])
def test_sizes_that_clash_are_refused(knots):
    with pytest.raises(lbt.errors.DimensionError, match="increasing knots"):
        ParameterFamily(knots=np.array(knots), matrices=np.zeros((1, 2, 3, 3)))


@pytest.mark.parametrize("coupling", [0.0, 1e-15, 0.1])
def test_rounding_does_not_couple_blocks_and_is_bounded(coupling):
    family = _two_axes(coupling)
    blocks, left = split_blocks(family, 1.0)
    assert [len(block.states) for block in blocks] == ([6] if coupling == 0.1 else [3, 3])
    first, last = blocks[0], blocks[-1]
    across = np.linalg.norm(first.S @ family.matrices[0, 0][:3, 3:] @ last.V) if left else 0.0
    assert (left > 0) == (coupling == 1e-15)
    assert across <= left <= 1e3 * coupling


def test_the_errors_of_balanced_coordinates_are_bounded():
    from support.rational import rational

    family = _two_axes(0.1)
    (block,), _ = split_blocks(family, 1.0)
    S, V = rational(block.S), rational(block.V)
    skew = np.linalg.norm((S @ V - rational(np.eye(6))).astype(float))
    A = S @ rational(family.matrices[0, 1]) @ V - rational(block.family.matrices[0, 1])
    assert 0 < skew <= block.skew < 1e-12
    assert 0 < np.linalg.norm(A.astype(float)) <= block.error


def test_equal_blocks_are_there_once():
    one = _two_axes(0.0).matrices[:, :, :3, :3]
    both = np.zeros((1, 2, 6, 6))
    both[..., :3, :3] = both[..., 3:, 3:] = one
    blocks, left = split_blocks(ParameterFamily(knots=np.array([0.5, 2]), matrices=both), 1.0)
    assert len(blocks) == 1
    assert left == 0
