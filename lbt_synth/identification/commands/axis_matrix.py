"""What a matrix between two pairs of axes does: signs, exchanged or rotated axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.validation import FloatArray, number, square

AxisKind: TypeAlias = Literal["diagonal", "swapped", "rotated", "mirrored", "general", "zero"]
_SIGMAS = 4.0
_TOLERANCE = 0.05  # of the largest element


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxisMatrix:
    """Structure of a matrix between axes.

    Attributes
    ----------
    kind : str
        "diagonal"; "swapped" (only the other diagonal is not zero); "rotated" or "mirrored" (a
        rotation, or one with a mirror, and gains along the axes before or after it); "general";
        "zero" (nothing differs from 0).
    signs : (axes,) tuple of int
        Signs of the elements on the diagonal, of a swapped matrix on the other one, of each row;
        of the gains of a rotation.
    angle_deg : float
        Angle of the rotation, -180 to 180 degrees: 0 or 180 of a diagonal; nan of a general
        matrix and of a swapped one.
    gains : (axes,) ndarray
        Size of each row, at least 0.
    """

    kind: AxisKind
    signs: tuple[int, ...]
    angle_deg: float
    gains: FloatArray


def classify_matrix(
    values: ArrayLike, errors: ArrayLike = 0.0, *, tolerance: float = _TOLERANCE
) -> AxisMatrix:
    """Return what a matrix (n, n) of one or two axes does: the first kind that fits.

    Elements within four standard errors of zero, or below a part of the largest one, the tolerance,
    count as zero.

    Examples
    --------
    >>> classify_matrix([[-0.3, 0.0], [0.01, 0.5]]).signs
    (-1, 1)
    >>> classify_matrix([[0.0, 0.4], [0.4, 0.0]]).kind
    'swapped'
    >>> turned = classify_matrix([[0.26, -0.15], [0.15, 0.26]])
    >>> turned.kind, round(turned.angle_deg)
    ('rotated', 30)
    """
    g = square(values, "values")
    part = number(tolerance, "tolerance", at_least=0)
    largest = float(np.max(np.abs(g), initial=0.0))
    doubt = _SIGMAS * np.broadcast_to(np.asarray(errors, dtype=float), g.shape)
    zero = np.abs(g) <= np.maximum(np.where(np.isfinite(doubt), doubt, np.inf), part * largest)
    gains = np.sqrt(np.sum(g**2, axis=1))
    if zero.all():
        return AxisMatrix(kind="zero", signs=(0,) * len(g), angle_deg=np.nan, gains=gains)
    if zero[~np.eye(len(g), dtype=np.bool_)].all():
        signs = _signs(np.where(np.diag(zero), 0.0, np.diag(g)))
        angle = {1: 0.0, -1: 180.0}.get(next(iter(set(signs))), np.nan)
        return AxisMatrix(
            kind="diagonal",
            signs=signs,
            angle_deg=angle if len(set(signs)) == 1 else np.nan,
            gains=gains,
        )
    if np.diag(zero).all():
        signs = _signs(np.where(zero, 0.0, g)[[0, 1], [1, 0]])
        return AxisMatrix(kind="swapped", signs=signs, angle_deg=np.nan, gains=gains)
    return _turned(g, float(np.max(np.minimum(doubt, largest))), part, gains)


def _signs(values: FloatArray) -> tuple[int, ...]:
    return tuple(int(sign) for sign in np.sign(values))


def _turned(g: FloatArray, doubt: float, part: float, gains: FloatArray) -> AxisMatrix:
    """Tell a rotation, or a mirror, with a gain per axis, from a general matrix (2, 2)."""
    left, sizes, right = np.linalg.svd(g)
    turn = left @ right
    mirrored = bool(np.linalg.det(turn) < 0)
    if sizes[1] <= max(part * sizes[0], doubt):
        return AxisMatrix(kind="general", signs=(0, 0), angle_deg=np.nan, gains=gains)
    stretches = (right.T @ np.diag(sizes) @ right, left @ np.diag(sizes) @ left.T)
    across = min(abs(float(stretch[0, 1])) for stretch in stretches)
    alike = across <= max(doubt, part * sizes[0])
    if not alike:
        return AxisMatrix(kind="general", signs=(0, 0), angle_deg=np.nan, gains=gains)
    angle = float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
    return AxisMatrix(
        kind="mirrored" if mirrored else "rotated", signs=(1, 1), angle_deg=angle, gains=gains
    )
