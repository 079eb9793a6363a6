"""What a matrix between two pairs of axes does: signs, exchanged axes, or a mixture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.validation import FloatArray, number, square

AxisKind: TypeAlias = Literal["diagonal", "swapped", "general", "zero"]
_SIGMAS = 4.0
_TOLERANCE = 0.05  # of the largest element


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxisMatrix:
    """Structure of a matrix between axes.

    Attributes
    ----------
    kind : str
        "diagonal"; "swapped" (only the other diagonal is not zero); "general" (a rotation, for
        example); "zero" (nothing differs from 0).
    signs : (axes,) tuple of int
        Signs of the elements on the diagonal, of a swapped matrix on the other one, of each row;
        0 of any other.
    """

    kind: AxisKind
    signs: tuple[int, ...]


def classify_matrix(
    values: ArrayLike, errors: ArrayLike = 0.0, *, tolerance: float = _TOLERANCE
) -> AxisMatrix:
    """Return what a matrix (n, n) of one or two axes does: the first kind that fits.

    Elements within four standard errors of zero, or below a part of the largest one, the tolerance,
    count as zero.
    """
    g = square(values, "values")
    part = number(tolerance, "tolerance", at_least=0)
    doubt = _SIGMAS * np.broadcast_to(np.asarray(errors, dtype=float), g.shape)
    least = np.where(np.isfinite(doubt), doubt, np.inf)
    g = np.where(np.abs(g) <= np.maximum(least, part * np.max(np.abs(g), initial=0.0)), 0.0, g)
    on, off = np.diag(g), (g - np.diag(np.diag(g))).sum(axis=1)
    if not g.any():
        return AxisMatrix(kind="zero", signs=(0,) * len(g))
    if not off.any():
        return AxisMatrix(kind="diagonal", signs=_signs(on))
    if not on.any():
        return AxisMatrix(kind="swapped", signs=_signs(off))
    return AxisMatrix(kind="general", signs=(0,) * len(g))


def _signs(values: FloatArray) -> tuple[int, ...]:
    return tuple(int(sign) for sign in np.sign(values))
