"""Find a sequence of a parameter that destabilises a system which is stable at each constant one.

A periodic sequence of the two ends of an interval is unstable if the product of its matrices has
a spectral radius above one. Sequences of p steps at one end and q at the other are tried first,
which pump a resonance; single steps of the best one are then flipped, dropped and repeated while
that makes it grow faster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear.moving_parameter.family import ParameterFamily, split_blocks
from lbt_synth.validation import BoolArray, FloatArray

_RUNS = np.unique(np.round(np.geomspace(1, 100, 28)).astype(np.int64))  # steps at one end
_LONGEST = 48  # period whose single steps are varied
_SEARCHES, _VARIATIONS, _BISECTIONS = 4, 20, 12
_NARROWER = 1e-3  # part of the share by which the next search must win
_UNSTABLE = 1 + 1e-9  # spectral radius of a product


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DestabilisingSequence:
    """A periodic sequence of the ends of an interval that makes a system unstable.

    Attributes
    ----------
    low, high : float
        The ends.
    at_high : (p,) ndarray of bool
        Whether the parameter is at the high end, in each step of a period.
    radius : float
        Spectral radius of the product of the matrices of one period, above 1.
    """

    low: float
    high: float
    at_high: BoolArray
    radius: float


def destabilising_sequence(
    A0: FloatArray, A1: FloatArray, *, low: float, high: float, nominal: float
) -> DestabilisingSequence | None:
    """Find a sequence that destabilises ``A0 + g A1``, within an interval as narrow as is found.

    Parameters
    ----------
    A0, A1 : (n, n) ndarray
        The family.
    low, high : float
        Widest ends, positive; narrower ones are ``nominal (low / nominal)^t`` to
        ``nominal (high / nominal)^t``.
    nominal : float
        A parameter between them.

    Returns
    -------
    DestabilisingSequence or None
        The sequence; None if none is found, which proves nothing.

    Examples
    --------
    Two stable matrices, of which the product is not:

    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> A0, A1 = np.array([[0.0, 1.3], [0.0, 0.0]]), np.array([[0.0, -1.0], [1.0, 0.0]])
    >>> [round(float(abs(np.linalg.eigvals(A0 + g * A1)).max()), 3) for g in (0.2, 1.1)]
    [0.469, 0.469]
    >>> found = lbt.linear.destabilising_sequence(A0, A1, low=0.2, high=1.1, nominal=0.5)
    >>> found.at_high.astype(int).tolist(), found.radius > 1
    ([0, 1], True)
    """
    found, share = None, 1.0
    family = ParameterFamily.affine(A0, A1, low=low, high=high)
    for block in split_blocks(family, nominal)[0]:
        for _ in range(_SEARCHES):
            found_here = _narrowest(block.family, nominal, share)
            if found_here is None:
                break
            share, found = found_here[0] * (1 - _NARROWER), found_here[1]
    return found


def _narrowest(
    family: ParameterFamily, nominal: float, share: float
) -> tuple[float, DestabilisingSequence] | None:
    """Return the worst sequence at a share of an interval, and the least at which it is unstable.

    None if that sequence is stable.
    """
    word = _worst_word(_ends(family, nominal, share)[1])
    narrow, wide, found = 0.0, share, None
    for middle in [share] + [np.nan] * _BISECTIONS:
        middle = (narrow + wide) / 2 if np.isnan(middle) else middle
        (low, high), pair = _ends(family, nominal, middle)
        radius = float(_radii(pair, word[None])[0])
        if radius > _UNSTABLE:
            wide = middle
            found = DestabilisingSequence(low=low, high=high, at_high=word, radius=radius)
        elif found is None:
            return None
        else:
            narrow = middle
    return None if found is None else (wide, found)


def _ends(
    family: ParameterFamily, nominal: float, share: float
) -> tuple[tuple[float, float], FloatArray]:
    """Return the ends of a share of an interval, and their matrices (2, n, n)."""
    ends = nominal * (family.knots[[0, -1]] / nominal) ** share
    return (float(ends[0]), float(ends[1])), family.at(ends)[0]


def _worst_word(pair: FloatArray) -> BoolArray:
    """Return the periodic sequence found that grows fastest per step, of two matrices."""
    powers = [np.stack([np.linalg.matrix_power(A, int(steps)) for steps in _RUNS]) for A in pair]
    products = powers[0][:, None] @ powers[1][None]
    lengths = _RUNS[:, None] + _RUNS[None]
    growth = np.max(np.abs(np.linalg.eigvals(products)), axis=-1) ** (1 / lengths)
    p, q = (int(_RUNS[i]) for i in np.unravel_index(np.argmax(growth), growth.shape))
    word, best = np.repeat([False, True], [p, q]), float(np.max(growth))
    for _ in range(_VARIATIONS if word.size <= _LONGEST else 0):
        candidates = [
            variation for step in range(word.size) for variation in _variations(word, step)
        ]
        rates = [
            (float(rate), word)
            for size in {len(candidate) for candidate in candidates}
            for group in [np.array([c for c in candidates if len(c) == size])]
            for rate, word in zip(_radii(pair, group) ** (1 / size), group, strict=True)
        ]
        fastest, candidate = max(rates, key=lambda pair: pair[0])
        if fastest <= best * (1 + 1e-9):
            break
        word, best = candidate, fastest
    return word


def _variations(word: BoolArray, step: int) -> list[BoolArray]:
    """Return a sequence with one step flipped, dropped and repeated."""
    flipped = word.copy()
    flipped[step] = not flipped[step]
    dropped = [np.delete(word, step)] if word.size > 1 else []
    return [flipped, *dropped, np.insert(word, step, word[step])]


def _radii(pair: FloatArray, words: BoolArray) -> FloatArray:
    """Return the spectral radius of the product of each sequence (N, p), the first step first."""
    product = np.broadcast_to(np.eye(pair.shape[-1]), (len(words), *pair.shape[1:]))
    for step in words.T:
        product = pair[step.astype(np.int64)] @ product
    return np.asarray(np.max(np.abs(np.linalg.eigvals(product)), axis=-1))
