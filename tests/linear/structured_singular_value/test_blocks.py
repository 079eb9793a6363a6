"""Blocks of an uncertainty and what commutes with them."""

from __future__ import annotations

import numpy as np
import pytest
from support.blocks import random_uncertainty

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import Block
from lbt_synth.linear.structured_singular_value.blocks import (
    balancing_scales,
    checked_blocks,
    commutants,
    has_structure,
)

BLOCKS = (Block(size=(2, 3)), Block(size=2, kind="complex"), Block(size=2, kind="real"))


def test_the_basis_commutes_with_every_uncertainty():
    delta = random_uncertainty(np.random.default_rng(0), BLOCKS)
    basis = commutants(BLOCKS)
    assert len(basis.outputs) == 1 + 4 + 4
    assert len(basis.skew) == 4
    for outputs, inputs in zip(basis.outputs, basis.inputs, strict=True):
        np.testing.assert_allclose(inputs @ delta, delta @ outputs, atol=1e-15)
    for skew in basis.skew:  # G Delta* = Delta G*
        np.testing.assert_allclose(skew @ delta.conj().T, delta @ skew.conj().T, atol=1e-15)


def test_structure_is_recognised():
    delta = random_uncertainty(np.random.default_rng(1), BLOCKS)
    assert has_structure(delta, BLOCKS)
    for row, column, value in ((0, 3, 1.0), (2, 3, 0.5), (4, 5, 1j)):
        other = np.array(delta)
        other[row, column] = value
        assert not has_structure(other, BLOCKS)


def test_balancing_makes_rows_and_columns_alike():
    matrix = np.array([[0, 8.0, 1], [2, 0, 4], [1, 16, 0]], dtype=complex)
    d = balancing_scales(matrix, [Block()] * 3)
    scaled = np.abs(d[:, None] * matrix / d)
    np.testing.assert_allclose(
        np.linalg.norm(scaled, axis=0), np.linalg.norm(scaled, axis=1), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Block(size=(1, 2), kind="real"), 'Try kind="full"'),
        (lambda: Block(kind="imaginary"), "kind must be"),
        (lambda: Block(size=(1, 2, 3)), "rows, columns"),
        (lambda: Block(size=0), "at least 1"),
        (lambda: checked_blocks([], (1, 1)), "one or more"),
    ],
)
def test_blocks_that_are_not_supported_are_refused(make, said):
    with pytest.raises(ProblemError, match=said):
        make()


def test_blocks_must_match_the_system():
    with pytest.raises(DimensionError, match="got 6 and 7"):
        checked_blocks(BLOCKS, (6, 6))
