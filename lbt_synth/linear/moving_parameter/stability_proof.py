"""Prove that a system stays stable while a parameter moves, by Lyapunov functions.

``V(x, g) = x' P(g) x`` decreases along ``x+ = A(g) x`` for every g of an interval and every next
value g+ that can follow it if::

    P(g) - A(g)' P(g+) A(g)  >  0,        P(g) > 0

**Any speed.** One P for all parameters: the ends of the interval are enough, since the left-hand
side is concave in g. Where the parameter enters by one channel, ``A = A_c + (g - c) b h'``, such a
P exists if and only if ``r ||h' (z I - A_c)^-1 b|| < 1`` for the interval ``c - r`` to ``c + r``
(the circle criterion, or the bounded real lemma; P. P. Khargonekar, I. R. Petersen, K. Zhou, IEEE
TAC 35, 356 (1990), doi:10.1109/9.50357), and it solves a Riccati equation. With several channels
the norm is sufficient.

**At most a rate per step.** P is affine between nodes. At each node it solves ``P = A' P A + I``
in balanced coordinates (or that Riccati equation, if A may be anywhere between two matrices),
divided by its trace: a factor, which would grow without bound towards an end where the loop loses
its stability, need not change with g. In a cell the left-hand
side is a cubic polynomial in g, affine in g+ - g, and its Bernstein coefficients must be positive
definite. From one cell to the next, g and g+ lie in a box, of which the corners are enough. Cells
that fail are halved.

Either way the inequalities are checked as they stand, with bounds on all rounding
(:func:`~lbt_synth.linear.moving_parameter.positive_definite.certainly_positive`); how P was found
does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from lbt_synth.linear.batched import frobenius_norms, transpose
from lbt_synth.linear.moving_parameter.family import Block, ParameterFamily, split_blocks
from lbt_synth.linear.moving_parameter.positive_definite import UNIT, certainly_positive
from lbt_synth.linear.riccati.routes import doubling
from lbt_synth.validation import BoolArray, FloatArray, read_only

_FIRST_CELLS = 32  # between two knots
_HALVINGS = 8  # of a cell, at most
_BISECTIONS = 10  # of the share of an interval for any speed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockProof:
    """Lyapunov function of a block: P(g), affine between nodes, in the coordinates of the block.

    For any speed all matrices are one.
    """

    nodes: FloatArray  # (c,)
    P: FloatArray  # (c, m, m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StabilityProof:
    """A proof that a family is uniformly exponentially stable, whatever its parameter does.

    Made by :func:`prove_any_speed` and :func:`prove_rate`.

    Attributes
    ----------
    low, high : float
        The interval that the parameter does not leave.
    rate : float
        Largest change of the parameter in one step; inf for any speed.
    blocks : tuple of BlockProof
        A Lyapunov function for each block of states that couples to no other.
    """

    low: float
    high: float
    rate: float
    blocks: tuple[BlockProof, ...]


def prove_any_speed(
    A0: FloatArray, A1: FloatArray, *, low: float, high: float, nominal: float
) -> StabilityProof | None:
    """Prove stability of ``A0 + g A1`` for g that moves at any speed between two ends.

    If that fails, between the ends of the widest interval ``nominal (low / nominal)^t`` to
    ``nominal (high / nominal)^t`` for which it does not, or None without any.

    Parameters
    ----------
    A0, A1 : (n, n) ndarray
        The family.
    low, high : float
        Ends of the interval, positive.
    nominal : float
        A parameter between them.

    Returns
    -------
    StabilityProof or None
        The proof.

    Examples
    --------
    For one state, the constant parameters decide:

    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> one, gain = np.array([[1.0]]), np.array([[-0.5]])
    >>> proof = lbt.linear.prove_any_speed(one, gain, low=0.01, high=3.99, nominal=1.0)
    >>> proof.low, proof.high
    (0.01, 3.99)
    """

    def proof(share: float) -> StabilityProof | None:
        near, far = (nominal * (end / nominal) ** share for end in (low, high))
        ends = (low, high) if share == 1 else (near, far)
        return _any_speed(ParameterFamily.affine(A0, A1, low=ends[0], high=ends[1]), nominal)

    if not low < nominal < high:
        return None
    best, proved, failed = proof(1.0), 0.0, 1.0
    if best is not None:
        return best
    for _ in range(_BISECTIONS):
        middle = (proved + failed) / 2
        found = proof(middle)
        best, proved, failed = (found, middle, failed) if found else (best, proved, middle)
    return best


def _any_speed(family: ParameterFamily, nominal: float) -> StabilityProof | None:
    """Prove stability at any speed on the whole of an affine family."""
    if not _is_stable(family, nominal):
        return None
    blocks, coupling = split_blocks(family, nominal)
    proofs = []
    for block in blocks:
        first, last = block.family.matrices[:1, 0], block.family.matrices[:1, -1]
        P = _bounded_real((first + last) / 2, (last - first) / 2, slack=1e-4, floor=1e-7)
        proofs.append(BlockProof(nodes=family.knots, P=read_only(np.concatenate([P, P]))))
    low, high = (float(end) for end in family.knots)
    proof = StabilityProof(low=low, high=high, rate=np.inf, blocks=tuple(proofs))
    return proof if _holds(proof, blocks, coupling) else None


def _bounded_real(
    centre: FloatArray, change: FloatArray, *, slack: float, floor: float
) -> FloatArray:
    """Return P (N, m, m) that decreases along ``centre + d change`` for all d in [-1, 1].

    It solves ``P = A'PA + C'C + A'PB (1/s^2 - B'PB)^-1 B'PA`` with ``B C = change`` and
    ``s = 1 + slack``, is divided by its trace, and nan where that has no solution. Without any
    change it is that of Lyapunov's equation. ``floor`` is what all states add to ``C'C``, over the
    size of the change.
    """
    left, values, right = np.linalg.svd(change)
    root, largest = np.sqrt(values)[:, None, :], values[:, :1, None]
    B, C = left * root, transpose(root) * right
    identity = np.eye(centre.shape[-1])
    weight = transpose(C) @ C + np.where(largest > 0, floor * largest, 1.0) * identity
    with np.errstate(all="ignore"):
        P, _ = doubling(centre, -((1 + slack) ** 2) * B @ transpose(B), weight)
        return np.asarray(P / np.trace(P, axis1=1, axis2=2)[:, None, None])


def prove_rate(family: ParameterFamily, *, rate: float, nominal: float) -> StabilityProof | None:
    """Prove stability for a parameter that moves by at most a rate per step.

    Parameters
    ----------
    family : ParameterFamily
        The family; the parameter does not leave its knots.
    rate : float
        Largest change in one step.
    nominal : float
        A parameter between the knots.

    Returns
    -------
    StabilityProof or None
        The proof, for the widest run of cells around the nominal parameter; None without any.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> one, gain = np.array([[1.0]]), np.array([[-0.5]])
    >>> family = lbt.linear.ParameterFamily.affine(one, gain, low=0.1, high=3.9)
    >>> proof = lbt.linear.prove_rate(family, rate=1e-3, nominal=1.0)
    >>> proof.low, proof.high
    (0.1, 3.9)
    """
    if not _is_stable(family, nominal):
        return None
    blocks, coupling = split_blocks(family, nominal)
    margin = _coupling_margin(blocks, coupling)
    runs = [_prove_block(block, rate, nominal, margin) for block in blocks]
    low = max((run.nodes[0] for run in runs if run), default=np.inf)
    high = min((run.nodes[-1] for run in runs if run), default=-np.inf)
    if not all(runs) or not low < high:
        return None
    found = tuple(run for run in runs if run)
    return StabilityProof(low=float(low), high=float(high), rate=rate, blocks=found)


def _is_stable(family: ParameterFamily, parameter: float) -> bool:
    there = family.at(np.array([parameter]))[:, 0]
    each = np.concatenate([there, np.mean(there, axis=0)[None]])
    return bool(np.max(np.abs(np.linalg.eigvals(each))) < 1)


def _prove_block(block: Block, rate: float, nominal: float, margin: float) -> BlockProof | None:
    """Return the widest run of cells around a parameter on which a block is proved stable."""
    knots = block.family.knots
    parts = [np.linspace(a, b, _cells(a, b, rate) + 1)[:-1] for a, b in pairwise(knots)]
    nodes = np.concatenate([*parts, knots[-1:]])
    P = _lyapunov_at(block, nodes)
    for _ in range(_HALVINGS):
        inside, across = _proved_cells(block, nodes, P, rate, margin)
        failed = ~inside
        failed[:-1] |= ~across
        failed[1:] |= ~across
        halved = failed & (np.diff(nodes) > 2 * rate)
        if not halved.any():
            break
        middles = (nodes[:-1] + nodes[1:])[halved] / 2
        order = np.argsort(np.concatenate([nodes, middles]))
        P = np.concatenate([P, _lyapunov_at(block, middles)])[order]
        nodes = np.concatenate([nodes, middles])[order]
    else:
        inside, across = _proved_cells(block, nodes, P, rate, margin)
    first = last = int(np.clip(np.searchsorted(nodes, nominal) - 1, 0, len(inside) - 1))
    if not inside[first]:
        return None
    while first > 0 and inside[first - 1] and across[first - 1]:
        first -= 1
    while last < len(inside) - 1 and inside[last + 1] and across[last]:
        last += 1
    run = slice(first, last + 2)
    return BlockProof(nodes=read_only(nodes[run]), P=read_only(P[run]))


def _cells(low: float, high: float, rate: float) -> int:
    """Return into how many cells an interval is divided first, none narrower than two steps."""
    return int(np.clip((high - low) / (2 * rate), 1, _FIRST_CELLS))


def _lyapunov_at(block: Block, nodes: FloatArray) -> FloatArray:
    """Return P at nodes, (c, m, m): for the hull of the vertices, which are opposite ends."""
    A = block.family.at(nodes)
    return _bounded_real(np.mean(A, axis=0), (A[-1] - A[0]) / 2, slack=0.05, floor=0.01)


def proof_holds(proof: StabilityProof, family: ParameterFamily, nominal: float) -> bool:
    """Check a proof against its family, as if nothing were known of how it was found."""
    blocks, coupling = split_blocks(family, nominal)
    return len(blocks) == len(proof.blocks) and _holds(proof, blocks, coupling)


def _holds(proof: StabilityProof, blocks: list[Block], coupling: float) -> bool:
    """Check all inequalities of a proof."""
    margin = _coupling_margin(blocks, coupling)
    for block, own in zip(blocks, proof.blocks, strict=True):
        if own.nodes[0] > proof.low or own.nodes[-1] < proof.high:
            return False
        if np.isinf(proof.rate):
            sound = bool(np.all(own.P[0] == own.P)) and bool(
                np.all(_decreases(block, own.P, own.P, block.family.at(own.nodes), margin))
            )
        else:
            inside, across = _proved_cells(block, own.nodes, own.P, proof.rate, margin)
            sound = bool(inside.all() and across.all())
        if not sound or not np.all(certainly_positive(own.P, np.zeros(len(own.P)))):
            return False
    return True


def _coupling_margin(blocks: list[Block], coupling: float) -> float:
    """Bound what a coupling takes from the inequalities of all blocks, with traces up to 3."""
    return 3 * coupling * (2 * max(block.size for block in blocks) + coupling)


def _decreases(
    block: Block, now: FloatArray, after: FloatArray, A: FloatArray, margin: float
) -> BoolArray:
    """Say where ``now - A' after A`` is positive for each vertex, A being (v, N, m, m)."""
    proved = [_proved(block, now, [(each, after, each)], each, margin) for each in A]
    return np.asarray(np.all(proved, axis=0))


def _proved(
    block: Block,
    now: FloatArray,
    terms: list[tuple[FloatArray, FloatArray, FloatArray]],
    sizes: FloatArray,
    margin: float,
) -> BoolArray:
    """Say where ``now - mean of A' P B`` over terms (A, P, B) is positive, whatever the rounding.

    With e and f the errors of ``S V`` and ``S A V``, p and a the norms of P and A, the exact
    difference is ``(S V)' now (S V) - ...``, away from the computed one by no more than
    ``p (2 e + e^2) + p (2 a f + f^2)``, and by the rounding of the products and of P between
    nodes, ``(8 n + 64) u p (1 + a)^2``.
    """
    found = now - sum(transpose(left) @ P @ right for left, P, right in terms) / len(terms)
    p = frobenius_norms(now) + sum(frobenius_norms(P) for _, P, _ in terms)
    a = frobenius_norms(sizes) + block.error
    e, f = block.skew, block.error
    rounding = (8 * now.shape[-1] + 64) * UNIT * (1 + a) ** 2
    errors = p * (rounding + 2 * a * f + f * f + 2 * e + e * e) + margin
    return certainly_positive(found, np.asarray(errors))


def _proved_cells(
    block: Block, nodes: FloatArray, P: FloatArray, rate: float, margin: float
) -> tuple[BoolArray, BoolArray]:
    """Say in which cells, and across which inner nodes, V decreases; P is positive there."""
    widths = np.diff(nodes)[:, None, None]
    slopes = np.diff(P, axis=0) / widths
    inside = widths[:, 0, 0] >= rate
    positive = certainly_positive(P, np.zeros(len(P)))
    inside &= positive[:-1] & positive[1:]
    across = np.ones(len(nodes) - 2, dtype=np.bool_)
    for A, step in product(block.family.at(nodes), (-rate, rate)):
        ends = P[:-1] + step * slopes, P[1:] + step * slopes
        inside &= _cubic_decreases(block, (P[:-1], P[1:]), ends, (A[:-1], A[1:]), margin)
    for side, before, beyond in ((1, slopes[:-1], slopes[1:]), (-1, slopes[1:], slopes[:-1])):
        for back, on in product((0.0, rate), (0.0, rate)):
            A = block.family.at(nodes[1:-1] - side * back)
            now, after = P[1:-1] - side * back * before, P[1:-1] + side * on * beyond
            across &= _decreases(block, now, after, A, margin)
    return inside, across


def _cubic_decreases(
    block: Block,
    now: tuple[FloatArray, FloatArray],
    after: tuple[FloatArray, FloatArray],
    A: tuple[FloatArray, FloatArray],
    margin: float,
) -> BoolArray:
    """Say where the Bernstein coefficients of ``now - A' after A`` are positive, all affine."""
    largest = np.where((frobenius_norms(A[0]) > frobenius_norms(A[1]))[:, None, None], A[0], A[1])
    proved = []
    for k in range(4):
        corners = (each for each in product((0, 1), repeat=3) if sum(each) == k)
        terms = [(A[a], after[p], A[b]) for a, p, b in corners]
        here = ((3 - k) * now[0] + k * now[1]) / 3
        proved.append(_proved(block, here, terms, largest, margin))
    return np.asarray(np.all(proved, axis=0))
