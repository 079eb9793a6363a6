"""Blocks of an uncertainty, and the matrices that commute with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import ComplexArray, FloatArray, choice, integer, set_fields

Place = tuple[slice, slice]  # of a block: inputs and outputs of the system
KINDS = ("full", "complex", "real")
_MOST_RATIO = 1e8  # of scales, where nothing comes back from a block
_SWEEPS = 10  # of the balancing, over all blocks


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """One block of an uncertainty ``w = Delta z``, from outputs of a system to its inputs.

    Parameters
    ----------
    size : int or (rows, columns), optional
        Size of the block: as many rows as it has inputs of the system, as many columns as outputs.
    kind : {"full", "complex", "real"}, optional
        A full matrix of complex numbers, or one complex or real number times the identity.

    Raises
    ------
    ProblemError
        If a number times the identity is not square, or the kind is another.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.linear.Block(size=2, kind="real").size
    (2, 2)
    """

    size: int | tuple[int, int] = 1
    kind: str = "full"

    def __post_init__(self) -> None:
        choice(self.kind, "kind", KINDS)
        both = self.size if isinstance(self.size, tuple | list) else (self.size, self.size)
        if len(both) != 2:
            raise ProblemError(f"size must be (rows, columns) or one number; got {self.size!r}.")
        rows, columns = (integer(each, "size", at_least=1) for each in both)
        if self.kind != "full" and rows != columns:
            raise ProblemError(
                f"a block of kind {self.kind!r} is one number times the identity, and square; got "
                f'{rows} x {columns}. Try kind="full"; full real blocks are not supported.'
            )
        set_fields(self, size=(rows, columns))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        assert isinstance(self.size, tuple)  # set by __post_init__
        return self.size


def checked_blocks(blocks: Sequence[Block], shape: tuple[int, int]) -> tuple[Block, ...]:
    """Return blocks that match a system of (outputs, inputs)."""
    given = tuple(blocks)
    if not given or not all(isinstance(each, Block) for each in given):
        raise ProblemError(f"blocks must be a sequence of Block, one or more; got {blocks!r}.")
    rows, columns = (sum(each.shape[i] for each in given) for i in (0, 1))
    if (columns, rows) != shape:
        raise DimensionError(
            f"the blocks must take the system's {shape[0]} outputs and give its {shape[1]} "
            f"inputs: {shape[1]} rows and {shape[0]} columns in all; got {rows} and {columns}."
        )
    return given


def places(blocks: Sequence[Block]) -> list[Place]:
    """Return the inputs and the outputs of the system that belong to each block."""
    ends = np.cumsum([(0, 0), *(each.shape for each in blocks)], axis=0)
    return [(slice(r0, r1), slice(c0, c1)) for (r0, c0), (r1, c1) in pairwise(ends.tolist())]


def has_structure(delta: ComplexArray, blocks: Sequence[Block]) -> bool:
    """Whether a matrix consists of these blocks, exactly."""
    left = np.array(delta)
    for block, (rows, columns) in zip(blocks, places(blocks), strict=True):
        own = delta[rows, columns]
        if block.kind != "full" and not np.array_equal(own, own[0, 0] * np.eye(len(own))):
            return False
        if block.kind == "real" and own[0, 0].imag != 0:
            return False
        left[rows, columns] = 0
    return not left.any()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Commutants:
    """A basis of the scales that commute with all blocks: D by k matrices, G by the rest.

    With outputs p, inputs q and a least size e of D itself: ``outputs`` (k, p, p), ``inputs``
    (k, q, q), ``least`` (k, e, e), and ``skew`` (g, q, p).
    """

    outputs: ComplexArray
    inputs: ComplexArray
    least: ComplexArray
    skew: ComplexArray


def commutants(blocks: Sequence[Block]) -> Commutants:
    """Return the basis of the scales of some blocks."""
    q, p = np.sum([each.shape for each in blocks], axis=0)
    e = sum(1 if each.kind == "full" else each.shape[0] for each in blocks)
    at = 0
    outputs: list[ComplexArray] = []
    inputs: list[ComplexArray] = []
    least: list[ComplexArray] = []
    skew: list[ComplexArray] = []
    for block, (rows, columns) in zip(blocks, places(blocks), strict=True):
        order = 1 if block.kind == "full" else block.shape[0]
        for unit in _hermitian_basis(order):
            for matrices, size, own in ((outputs, p, columns), (inputs, q, rows)):
                count = own.stop - own.start
                matrices.append(np.zeros((size, size), dtype=complex))
                matrices[-1][own, own] = unit[0, 0] * np.eye(count) if order == 1 else unit
            least.append(np.zeros((e, e), dtype=complex))
            least[-1][at : at + order, at : at + order] = unit
            if block.kind == "real":
                skew.append(np.zeros((q, p), dtype=complex))
                skew[-1][rows, columns] = unit
        at += order
    return Commutants(
        outputs=np.array(outputs),
        inputs=np.array(inputs),
        least=np.array(least),
        skew=np.array(skew) if skew else np.zeros((0, q, p), dtype=complex),
    )


def _hermitian_basis(order: int) -> Iterator[ComplexArray]:
    """Yield the units of the Hermitian matrices of an order."""
    for i in range(order):
        for j in range(i + 1):
            for value in (1.0,) if i == j else (1.0, 1j):
                unit = np.zeros((order, order), dtype=complex)
                unit[i, j], unit[j, i] = value, np.conj(value)
                yield unit


def balancing_scales(matrix: ComplexArray, blocks: Sequence[Block]) -> FloatArray:
    """Return one scale per block that makes its rows and columns off the diagonal alike.

    They minimise the Frobenius norm: E. E. Osborne, J. ACM 7, 338 (1960),
    doi:10.1145/321043.321048. For two scalars, whose determinant no scaling changes, they minimise
    the largest singular value as well.
    """
    own = places(blocks)
    size = np.array([[np.linalg.norm(matrix[c, r]) for r, _ in own] for _, c in own])
    np.fill_diagonal(size, 0.0)
    tiny = max(float(size.max()) / _MOST_RATIO, np.finfo(float).tiny)
    scales = np.ones(len(own))
    for _ in range(_SWEEPS if len(own) > 1 else 0):
        for i in range(len(own)):
            row = float(np.linalg.norm(scales[i] * size[i] / scales))
            column = float(np.linalg.norm(scales * size[:, i] / scales[i]))
            scales[i] *= np.sqrt(max(column, tiny) / max(row, tiny))
    return np.asarray(np.clip(scales / scales.max(), 1 / _MOST_RATIO, 1.0))
