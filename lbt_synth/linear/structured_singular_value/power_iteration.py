"""The lower bound of the structured singular value of a matrix, by an uncertainty that attains it.

A. Packard, M. Fan, J. Doyle, "A power method for the structured singular value", Proc. 27th IEEE
CDC, 2132 (1988), doi:10.1109/CDC.1988.194710; for real blocks P. Young, J. Doyle, Proc. 29th IEEE
CDC, 1233 (1990), doi:10.1109/CDC.1990.203801. It need not converge: each of its structures is
scaled until ``I - M Delta`` is singular, and what counts is that it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lbt_synth.linear.structured_singular_value.blocks import Block, Place, has_structure, places
from lbt_synth.linear.structured_singular_value.scales import Scales
from lbt_synth.validation import ComplexArray

_STARTS, _ITERATIONS, _EVERY = 6, 60, 5
_SINGULAR = 1e-12  # of the least singular value of I - M Delta, over one
_CLOSE = 1e-4  # relative, below the upper bound: no better is sought
_TURNS = 100  # of the complex blocks, until the eigenvalue is real


def destabilising_delta(
    matrix: ComplexArray, blocks: Sequence[Block], scales: Scales
) -> ComplexArray | None:
    """Return the smallest uncertainty found that makes ``I - M Delta`` singular, or None."""
    own, enough = places(blocks), scales.bound(matrix) * (1 - _CLOSE)
    scaled, _ = scales.apply(matrix)
    _, R_inverse = scales.factors()
    _, _, right = np.linalg.svd(scaled)
    rng = np.random.default_rng(0)
    best: ComplexArray | None = None
    for start in range(_STARTS):
        b = R_inverse @ right[0].conj() if start == 0 else _random(rng, matrix.shape[1])
        w = R_inverse @ right[0].conj() if start == 0 else _random(rng, matrix.shape[1])
        for step in range(_ITERATIONS):
            a = _unit(matrix @ b)
            z, _, _ = _align(a, w, b, blocks, own)
            w = _unit(matrix.conj().T @ z)
            _, b, structure = _align(a, w, b, blocks, own)
            b = _unit(b)
            if step % _EVERY == _EVERY - 1:
                found = _scaled_to_singular(matrix, structure, blocks, own)
                if found is not None and (best is None or _size(found) < _size(best)):
                    best = found
                    if 1 / _size(best) >= enough:
                        return best
    return best


def _size(delta: ComplexArray) -> float:
    return float(np.linalg.norm(delta, 2))


def _align(
    a: ComplexArray, w: ComplexArray, b: ComplexArray, blocks: Sequence[Block], own: list[Place]
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return ``z = Q* w`` and ``b = Q a`` of the structure Q of norm one that aligns a with w."""
    Q = np.zeros((len(w), len(a)), dtype=complex)
    for block, (rows, columns) in zip(blocks, own, strict=True):
        wi, ai, bi = w[rows], a[columns], b[rows]
        sizes = float(np.linalg.norm(wi) * np.linalg.norm(ai))
        if block.kind == "full":
            Q[rows, columns] = np.outer(wi, ai.conj()) / max(sizes, 1e-300)
            continue
        product = complex(np.vdot(ai, wi))
        if block.kind == "complex":
            q = product / abs(product) if product else 1.0
        else:
            old = np.vdot(ai, bi).real
            sign = 1.0 if old >= 0 else -1.0
            ratio = np.linalg.norm(bi) / max(float(np.linalg.norm(ai)), 1e-300)
            q = float(np.clip(sign * ratio + product.real / max(sizes, 1e-300), -1, 1))
        Q[rows, columns] = q * np.eye(len(ai))
    return Q.conj().T @ w, Q @ a, Q


def _scaled_to_singular(
    matrix: ComplexArray, structure: ComplexArray, blocks: Sequence[Block], own: list[Place]
) -> ComplexArray | None:
    """Scale a structure until ``I - M Delta`` is singular; None if that is not to be had."""
    turned = np.array(structure)
    has_real = any(each.kind == "real" for each in blocks)
    loop = np.linalg.eigvals(matrix @ turned)
    value = loop[np.argmax(np.abs(loop) if not has_real else np.abs(loop.real))]
    if not has_real:
        if value == 0:
            return None
        turned = turned / value
    else:
        for _ in range(_TURNS):  # the complex blocks turn until the eigenvalue is real
            if value.real == 0:
                return None
            turn = np.sign(value.real) * abs(value) / value
            for block, (rows, columns) in zip(blocks, own, strict=True):
                if block.kind != "real":
                    turned[rows, columns] *= turn
            loop = np.linalg.eigvals(matrix @ turned)
            value = loop[np.argmin(np.abs(loop - value))]
            if abs(value.imag) <= 1e-14 * abs(value):
                break
        if value.real == 0:
            return None
        turned = turned / value.real
    residual = np.linalg.svd(np.eye(len(matrix)) - matrix @ turned, compute_uv=False)
    proper = residual[-1] <= _SINGULAR * max(1.0, float(residual[0]))
    return turned if proper and has_structure(turned, blocks) else None


def _unit(vector: ComplexArray) -> ComplexArray:
    size = np.linalg.norm(vector)
    return vector / size if size > 0 else vector


def _random(rng: np.random.Generator, size: int) -> ComplexArray:
    return _unit(rng.normal(size=size) + 1j * rng.normal(size=size))
