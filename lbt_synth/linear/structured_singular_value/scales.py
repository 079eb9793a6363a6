"""The upper bound of the structured singular value of a matrix, by scales.

With D > 0 and Hermitian G that commute with the blocks, ``mu(M) <= beta`` if
``M* D M + j (G M - M* G*) <= beta^2 D``: M. Fan, A. Tits, J. Doyle, IEEE Trans. Autom. Control 36,
25 (1991), doi:10.1109/9.62265. The least beta is a generalised eigenvalue problem, solved by
centres: S. Boyd, L. El Ghaoui, Linear Algebra Appl. 188, 63 (1993),
doi:10.1016/0024-3795(93)90465-Z. What is returned is computed again from the scales.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh, null_space

from lbt_synth.linear.structured_singular_value.blocks import (
    Block,
    Commutants,
    balancing_scales,
    commutants,
)
from lbt_synth.validation import ComplexArray, FloatArray

_GAP = 1e-7  # relative, of beta^2, above the least that any scales reach
_STEPS, _NEWTON = 80, 40
_SHRINK = 0.4  # of the distance of a level from the bound, per centre
_CENTRED = 0.05  # of the Newton decrement
_EASY = 0.8  # of the level: there balancing alone is enough


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scales:
    """Scales that prove an upper bound: D on the outputs and on the inputs, and G.

    Attributes
    ----------
    outputs : (p, p) complex ndarray
        D where it multiplies the outputs of the system, Hermitian and positive.
    inputs : (q, q) complex ndarray
        The same D where it multiplies the inputs.
    skew : (q, p) complex ndarray
        G, zero but for real blocks.
    """

    outputs: ComplexArray
    inputs: ComplexArray
    skew: ComplexArray

    def bound(self, matrix: ComplexArray) -> float:
        """Return the upper bound that the scales prove for a matrix, with a margin for rounding."""
        scaled, skew = self.apply(matrix)
        if not skew.any():
            return float(np.linalg.norm(scaled, 2)) * (1 + 1e-14 * len(matrix))
        form = scaled.conj().T @ scaled + 1j * (skew @ scaled - (skew @ scaled).conj().T)
        size = np.linalg.norm(scaled) ** 2 + np.linalg.norm(skew @ scaled)
        return float(np.sqrt(max(np.linalg.eigvalsh(form)[-1] + 1e-14 * size, 0.0)))

    def factors(self) -> tuple[ComplexArray, ComplexArray]:
        """Return ``L`` and ``R^-1`` with ``D = L* L`` on the outputs and ``D = R* R`` on inputs."""
        L = np.linalg.cholesky(self.outputs).conj().T
        R = np.linalg.cholesky(self.inputs).conj().T
        return np.asarray(L, dtype=np.complex128), np.linalg.inv(R).astype(np.complex128)

    def apply(self, matrix: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return ``L M R^-1`` and ``R^-* G L^-1``."""
        L, R_inverse = self.factors()
        return L @ matrix @ R_inverse, R_inverse.conj().T @ self.skew @ np.linalg.inv(L)


def best_scales(matrix: ComplexArray, blocks: Sequence[Block], level: float = 0.0) -> Scales:
    """Return the scales of the least bound, or those in the middle of all that reach a level."""
    own = balancing_scales(matrix, blocks)
    rows, columns = (np.repeat(own, [each.shape[i] for each in blocks]) for i in (0, 1))
    balanced = columns[:, None] * matrix / rows
    basis = commutants(blocks)
    x = np.tensordot(basis.least, np.eye(basis.least.shape[1]), 2).real
    x = np.concatenate([x, np.zeros(len(basis.skew))])
    size = float(np.linalg.norm(balanced, 2))
    # two scalars, whose determinant no scaling changes, need no more
    is_best = len(blocks) <= 2 and all(b.shape == (1, 1) and b.kind != "real" for b in blocks)
    if not is_best and size > max(_EASY * level, 0.0):
        x = _centre_path(balanced / size, basis, x, (level / size) ** 2)
    k = len(basis.outputs)
    parts = (x[:k], basis.outputs), (x[:k], basis.inputs), (size * x[k:], basis.skew)
    D_outputs, D_inputs, G = (np.einsum("k,kij->ij", *part).astype(complex) for part in parts)
    return Scales(
        outputs=columns[:, None] * D_outputs * columns,
        inputs=rows[:, None] * D_inputs * rows,
        skew=rows[:, None] * G * columns,
    )


def _centre_path(
    matrix: ComplexArray, basis: Commutants, x: FloatArray, floor: float
) -> FloatArray:
    """Follow the centres of ``t D - M* D M - j (G M - M* G*) > 0``, D > 0, to the least t."""
    skewed = 1j * basis.skew @ matrix
    H = np.concatenate(
        [matrix.conj().T @ basis.outputs @ matrix, skewed + skewed.conj().swapaxes(1, 2)]
    )
    P = np.concatenate([basis.inputs, np.zeros_like(skewed)])
    E = np.concatenate([basis.least, np.zeros((len(skewed), *basis.least.shape[1:]))])
    best, least = x, np.inf
    t = max(1.5, floor)
    for _ in range(_STEPS):
        try:
            x = _centre(t * P - H, E, x)
            attained = _largest_ratio(H, P, x)
            if attained < least or t <= floor:
                best, least = x, attained
            if t <= floor or attained < 0 or _below(t * P - H, P, E, x) < _GAP * t:
                break
        except np.linalg.LinAlgError:  # rounding: x is at its level
            break
        t = max(attained + _SHRINK * (t - attained), floor)
    return best


def _centre(F: ComplexArray, E: ComplexArray, x: FloatArray) -> FloatArray:
    """Minimise ``-log det F(x) - log det E(x)`` by Newton's method, at a constant trace of E.

    Each step is a least-squares problem, which does not square the condition of the Hessian.
    """
    trace = np.trace(E, axis1=1, axis2=2).real
    target = np.concatenate([np.eye(part.shape[1]).ravel() for part in (F, E)])
    target = np.concatenate([target, np.zeros_like(target)])
    factors = _factors(x, F, E)
    for _ in range(_NEWTON):
        moved = []
        for factor, part in zip(factors, (F, E), strict=True):
            inverse = np.linalg.inv(factor)
            moved.append((inverse @ part @ inverse.conj().T).reshape(len(x), -1))
        both = np.concatenate(moved, axis=1)
        rows = np.concatenate([both.real, both.imag], axis=1)
        size = np.linalg.norm(rows, axis=1)
        unit = 1 / np.where(size > 0, size, 1.0)  # a G that does nothing
        free = unit[:, None] * null_space((unit * trace)[None, :])
        step = free @ np.linalg.lstsq(rows.T @ free, target, rcond=1e-14)[0]
        decrement = float(np.linalg.norm(step @ rows))
        if decrement < _CENTRED:
            break
        try:
            moved_x = x + step / (1 + decrement)
            factors = _factors(moved_x, F, E)
        except np.linalg.LinAlgError:  # rounding
            break
        x = moved_x
    return x


def _factors(x: FloatArray, *parts: ComplexArray) -> list[ComplexArray]:
    """Return the Cholesky factors of forms at a point; LinAlgError outside."""
    return [np.linalg.cholesky(np.einsum("k,kij->ij", x, part)) for part in parts]


def _largest_ratio(H: ComplexArray, P: ComplexArray, x: FloatArray) -> float:
    """Return the least t with ``H(x) <= t P(x)``."""
    return float(eigh(np.tensordot(x, H, 1), np.tensordot(x, P, 1), eigvals_only=True)[-1])


def _below(F: ComplexArray, P: ComplexArray, E: ComplexArray, x: FloatArray) -> float:
    """Return how far below its level any scales can reach at most, by duality at a centre."""
    inverse = np.linalg.inv(np.tensordot(x, F, 1))
    own = E[np.any(E, axis=(1, 2))]
    gram = np.einsum("kij,lij->kl", own.conj(), own).real
    # what the dual point weighs D with, as matrices of the size of D
    weight, slack = (
        np.tensordot(np.linalg.solve(gram, each), own, 1)
        for each in np.einsum("nkij,ij->nk", np.stack([P, F])[:, : len(own)].conj(), inverse).real
    )
    return float(np.max(np.linalg.eigvals(np.linalg.solve(weight, slack)).real))
