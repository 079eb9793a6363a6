"""Matrices that follow a parameter, affine between knots, in balanced blocks of states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import DimensionError
from lbt_synth.linear.batched import frobenius_norms
from lbt_synth.linear.connected_parts import connected_parts
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.moving_parameter.positive_definite import UNIT
from lbt_synth.validation import FloatArray, IntArray, real_array, set_fields

_COUPLING = 1e-13  # part of the largest entry below which one does not couple two blocks
_RANK = 1e-6  # share of its trace added to a Gramian, so that no direction is lost
_UNSEEN = 1e-12  # a state smaller than this part of the largest is not scaled


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ParameterFamily:
    """The system ``x(k+1) = A(g(k)) x(k)``, with A affine in g between knots.

    Parameters
    ----------
    knots : (k,) ndarray
        Values of the parameter, increasing, at least two; it does not leave them.
    matrices : (v, k, n, n) ndarray
        The matrix at each knot, or v of them: A(g) may then be anywhere in their convex hull,
        and move in it at any speed.

    Raises
    ------
    DimensionError
        If the sizes clash.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> one, gain = np.array([[1.0]]), np.array([[-0.5]])
    >>> family = lbt.linear.ParameterFamily.affine(one, gain, low=0.1, high=3.9)
    >>> family.at(np.array([1.0])).ravel().round(12).tolist()
    [0.5]
    """

    knots: FloatArray
    matrices: FloatArray

    def __post_init__(self) -> None:
        knots, matrices = real_array(self.knots, "knots"), real_array(self.matrices, "matrices")
        fits = matrices.ndim == 4 and matrices.shape[1:] == (knots.size, *matrices.shape[2:3] * 2)
        if knots.ndim != 1 or knots.size < 2 or not np.all(np.diff(knots) > 0) or not fits:
            raise DimensionError(
                "a family needs two or more increasing knots (k,) and matrices (v, k, n, n); got "
                f"{knots.shape} and {matrices.shape}."
            )
        set_fields(self, knots=knots, matrices=matrices)

    @classmethod
    def affine(cls, A0: FloatArray, A1: FloatArray, *, low: float, high: float) -> ParameterFamily:
        """Return the family ``A0 + g A1``, both (n, n), between two ends."""
        knots = np.array([low, high])
        return cls(knots=knots, matrices=(A0 + knots[:, None, None] * A1)[None])

    def at(self, parameters: FloatArray) -> FloatArray:
        """Return the matrices at some parameters (p,), which are (v, p, n, n)."""
        cell = np.clip(np.searchsorted(self.knots, parameters, "right") - 1, 0, len(self.knots) - 2)
        left, right = self.knots[cell], self.knots[cell + 1]
        share = ((parameters - left) / (right - left))[:, None, None]
        return np.asarray((1 - share) * self.matrices[:, cell] + share * self.matrices[:, cell + 1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    """States that couple to no others, in balanced coordinates ``S x`` (rounded numbers).

    With V close to the inverse of S, the exact ``S A V`` differ from the matrices of the family by
    at most ``error``, and ``S V`` from the identity by at most ``skew``, in the Frobenius norm.
    """

    states: tuple[int, ...]
    S: FloatArray
    V: FloatArray
    family: ParameterFamily
    error: float
    skew: float

    @property
    def size(self) -> float:
        """Largest Frobenius norm of a matrix of the family."""
        return float(np.max(frobenius_norms(self.family.matrices))) + self.error


def split_blocks(family: ParameterFamily, nominal: float) -> tuple[list[Block], float]:
    """Return the blocks of a family, and the largest norm of what couples them by rounding.

    Equal blocks are there once.
    """
    entries = np.max(np.abs(family.matrices), axis=(0, 1))
    coupled = entries > _COUPLING * np.max(entries)
    labels = connected_parts(coupled)
    blocks: dict[bytes, Block] = {}
    whole_S, whole_V = np.zeros((2, *entries.shape))
    for label in range(np.max(labels) + 1):
        states = np.flatnonzero(labels == label).astype(np.int64)
        own = family.matrices[..., states[:, None], states]
        key = own.tobytes()
        if key not in blocks:
            blocks[key] = _balanced_block(
                states, ParameterFamily(knots=family.knots, matrices=own), nominal
            )
        whole_S[np.ix_(states, states)] = np.abs(blocks[key].S)
        whole_V[np.ix_(states, states)] = np.abs(blocks[key].V)
    between = np.where(labels[:, None] == labels, 0.0, entries)
    coupling = float(np.linalg.norm(whole_S @ between @ whole_V)) * (1 + len(entries) * 4 * UNIT)
    return list(blocks.values()), coupling


def _balanced_block(states: IntArray, family: ParameterFamily, nominal: float) -> Block:
    """Balance a block at the nominal parameter; S is rounded, and its inverse as well."""
    S, V = _balanced_coordinates(family, nominal)
    n, terms = len(S), np.abs(S) @ np.abs(family.matrices) @ np.abs(V)
    balanced = ParameterFamily(knots=family.knots, matrices=S @ family.matrices @ V)
    largest = float(np.max(frobenius_norms(balanced.matrices)))
    # of the products, and of the interpolation between knots
    error = UNIT * ((2 * n + 8) * float(np.max(frobenius_norms(terms))) + 16 * largest)
    product = S @ V - np.eye(n)
    skew = float(np.linalg.norm(product))
    skew += (n + 4) * UNIT * float(np.linalg.norm(np.abs(S) @ np.abs(V)))
    members = tuple(int(state) for state in states)
    return Block(states=members, S=S, V=V, family=balanced, error=error, skew=skew)


def _balanced_coordinates(family: ParameterFamily, nominal: float) -> tuple[FloatArray, FloatArray]:
    """Return S and its inverse, in which what changes drives the states as much as it reads."""
    there = family.at(np.array([nominal]))[:, 0]
    A, n = np.mean(there, axis=0), there.shape[-1]
    ends = family.matrices[0] if len(there) == 1 else there
    left, values, right = np.linalg.svd(ends[-1] - ends[0])
    rank = max(int(np.sum(values > _UNSEEN * values[0])), 1)
    B = left[:, :rank] * values[:rank] if values[0] > 0 else np.eye(n)
    C = right[:rank] if values[0] > 0 else np.eye(n)
    deviations = np.sqrt(np.maximum(np.diag(stationary_covariance(A, B @ B.T)), 0.0))
    tiny = deviations <= _UNSEEN * np.max(deviations)
    units = np.where(tiny, np.max(deviations), deviations)
    A, B, C = A * units / units[:, None], B / units[:, None], C * units
    reached, seen = stationary_covariance(A, B @ B.T), stationary_covariance(A.T, C.T @ C)
    if not np.isfinite([reached, seen]).all():  # next to the unit circle
        return np.eye(n), np.eye(n)
    roots = [_square_root(each) for each in (reached, seen)]
    _, hankel, turn = np.linalg.svd(roots[1].T @ roots[0])
    V = units[:, None] * (roots[0] @ turn.T / np.sqrt(hankel))
    return np.linalg.inv(V), V


def _square_root(gramian: FloatArray) -> FloatArray:
    """Return a root of a Gramian in which no direction is lost."""
    values, vectors = np.linalg.eigh(gramian)
    return np.asarray(vectors * np.sqrt(np.maximum(values, _RANK * np.mean(values))))
