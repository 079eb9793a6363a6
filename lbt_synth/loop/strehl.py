"""Strehl ratio of a jittering image, an exact integral over the optical transfer function.

A long exposure multiplies the transfer function by the characteristic function
of the jitter. For an image that moves by Gaussian jitter of covariance S and by
sinusoids of complex amplitude a::

    SR = int OTF(f) exp(-2 pi^2 f'S f) prod J0(2 pi |f.a|) df / int OTF(f) df
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Annotated, Any

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import ArrayLike
from scipy.special import ive, j0, j1

from lbt_synth.errors import DimensionError
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.loop.budget import ResidualBudget
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    Obstruction,
    Positive,
    check_fields,
    real_array,
    require_instance,
    semidefinite,
)

_DIRECTIONS = 64  # of nodes in half a turn, for jitter of at most _TURNS
_TURNS = 5.0  # of phase over the pupil; beyond them the nodes are made denser
_FEW_TURNS = np.array([1.5, 0.7, 0.25])  # below each, half of the directions is as good: 2e-9
_FEW_RADII = {-1: 24, -2: 20, -3: 10}  # that are as good where the directions are fewer
_POINT_CHUNK = 200_000  # values of the integrand at once
_MOST_TURNS = 160.0  # of phase over the pupil; the image is gone long before


@dataclass(frozen=True, slots=True, kw_only=True)
class Imaging:
    """The camera behind the loop.

    Parameters
    ----------
    diameter_m : float, optional
        Telescope diameter [m], for records. Strehl ratios do not depend on it: a tilt of a
        nm rms moves the image by ``4 a / wavelength`` in units of lambda/D.
    obstruction : float, optional
        Diameter of the central obstruction as a fraction of the telescope's.
    wavelength_um : float, optional
        Imaging wavelength [um].
    other_modes : float, optional
        Strehl ratio, in (0, 1], that all other modes leave.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.Imaging(diameter_m=8.22, obstruction=0.11).wavelength_um
    2.2
    """

    diameter_m: Positive | None = None
    obstruction: Obstruction = 0.0
    wavelength_um: Positive = 2.2
    other_modes: Annotated[float, ("above", 0), ("at_most", 1)] = 1.0

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def label(self) -> str:
        """What tables call its Strehl ratio, with the wavelength."""
        return f"Strehl ratio at {self.wavelength_um:g} um"

    @property
    def cycles_per_nm(self) -> float:
        """Highest spatial frequency, in cycles per nm of tilt, ``D / 4`` of an angle."""
        return 4 / (self.wavelength_um * 1e3)


def strehl(
    residual: ResidualBudget | ArrayLike, imaging: Imaging, *, line_amplitudes_nm: ArrayLike = ()
) -> Any:
    """Strehl ratio, in [0, 1], of the exact residual of a loop or of many, on one or two axes.

    Parameters
    ----------
    residual : ResidualBudget, or (2, 2), (1, 1) or (p, n, n) array_like
        Residual of tip and tilt, of one loop or of p; or covariance of Gaussian jitter on the axes
        [nm^2 rms wavefront].
    imaging : Imaging
        The camera.
    line_amplitudes_nm : (s, n) or (p, s, n) complex array_like, optional
        Beside a covariance, amplitude and phase of each sinusoid on each axis [nm]; the sinusoids
        must have different frequencies.

    Returns
    -------
    float or (p,) ndarray
        Long-exposure Strehl ratio, the other modes included; 0 where the image moves by more than
        160 times its width, nan where a loop is unstable.

    Raises
    ------
    ProblemError
        If there are more than two axes, a value is not finite, the covariance is indefinite, or
        sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> camera = lbt.Imaging(diameter_m=8.22)
    >>> round(lbt.strehl([[300**2, 0], [0, 300**2]], camera), 3)
    0.379
    """
    require_instance(imaging, Imaging, "imaging")
    if isinstance(residual, ResidualBudget):
        stable, jitter = np.asarray(residual.stable), residual.gaussian_nm2
        lines = residual.line_amplitudes_nm
    else:
        if not np.ndim(residual):
            got = type(residual).__name__
            raise DimensionError(f"the covariance must be a matrix; got {got}. Try [[rms_nm**2]].")
        jitter = semidefinite(residual, "the covariance", stacked=True)
        stable, lines = np.ones(jitter.shape[:-2], bool), np.asarray(line_amplitudes_nm, complex)
        real_array(np.abs(lines), "line_amplitudes_nm")
        lines = lines if lines.size else np.zeros((*stable.shape, 0, jitter.shape[-1]), complex)
        if (*lines.shape[:-2], lines.shape[-1]) != jitter.shape[:-1]:
            counts = (*stable.shape, "sinusoids", jitter.shape[-1])
            raise DimensionError(
                f"line_amplitudes_nm must be ({', '.join(map(str, counts))}); got {lines.shape}."
            )
    _require_axes(jitter.shape[-1])
    jitter, lines = jitter[stable], lines[stable]
    deviation = np.sqrt(np.maximum(np.linalg.eigvalsh(jitter)[:, -1], 0.0))
    spread = (deviation + np.sum(np.abs(lines), axis=(1, 2))) * imaging.cycles_per_nm
    ratios, near = np.zeros(len(spread)), spread <= _MOST_TURNS
    if np.any(near):
        ratios[near] = _integrated_otf(jitter[near], lines[near], spread[near], imaging)
    out = np.full(stable.shape, np.nan)
    out[stable] = ratios
    return out if out.ndim else float(out)


def _integrated_otf(
    covariance: FloatArray, lines: ComplexArray, spread: FloatArray, imaging: Imaging
) -> FloatArray:
    """Return Strehl ratios (p,) of jitters of a spread (p,), in turns of phase over the pupil."""
    fineness = np.ceil(np.log2(np.maximum(spread / _TURNS, 1.0))).astype(np.int64)
    fineness -= np.sum(spread[:, None] < _FEW_TURNS, axis=1)
    # |f.a|^2 and f'Sf are quadratic forms of f
    forms = _quadratic_form(np.real(np.einsum("psi,psj->psij", lines, lines.conj())))
    widths = _quadratic_form(covariance)
    out = np.empty(len(spread))
    still = ~np.any(lines, axis=(1, 2))
    for level, is_still in sorted(set(zip(fineness.tolist(), still.tolist(), strict=True))):
        members = np.flatnonzero((fineness == level) & (still == is_still))
        if is_still:
            radius, weight = _radial_otf(imaging.obstruction, level)
            square = 2 * (np.pi * imaging.cycles_per_nm * radius) ** 2
            xx, xy, yy = widths[members].T
            # the mean of exp(-x cos) over all directions is I0(x)
            turning = np.hypot((xx - yy) / 2, xy)
            factor = ive(0, np.outer(turning, square))
            factor *= np.exp(-np.outer((xx + yy) / 2 - turning, square))
            out[members] = factor @ weight
            continue
        squares, weight = _weighted_otf(imaging.obstruction, level)
        squares = squares * imaging.cycles_per_nm**2
        step = max(1, _POINT_CHUNK // weight.size)
        for start in range(0, len(members), step):
            part = members[start : start + step]
            factor = np.exp(-2 * np.pi**2 * (widths[part] @ squares))
            for form in forms[part].swapaxes(0, 1):
                if np.any(form):
                    factor = factor * j0(2 * np.pi * np.sqrt(np.maximum(form @ squares, 0)))
            out[part] = factor @ weight
    return imaging.other_modes * np.minimum(out, 1.0)


def _quadratic_form(matrices: FloatArray) -> FloatArray:
    """Coefficients of symmetric matrices' quadratic forms, as factors of the squares of f."""
    if matrices.shape[-1] == 1:
        matrices = matrices * np.diag([1.0, 0.0])
    return np.stack([matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]], axis=-1)


def series_strehl(
    residual_nm: ArrayLike, imaging: Imaging, *, within_nm2: ArrayLike = 0.0
) -> float:
    """Long-exposure Strehl ratio of a residual series (frames, axes), whatever its distribution.

    It is the mean, over the frames, of the image of a star at its mean position. What moves within
    a frame counts by its variance: the star stands a deviation to either side on each axis.
    """
    require_instance(imaging, Imaging, "imaging")
    series = real_array(residual_nm, "residual_nm")
    if series.ndim != 2 or series.shape[0] == 0:
        raise DimensionError(f"residual_nm must be (frames, axes); got shape {series.shape}.")
    _require_axes(series.shape[1])
    axes = series.shape[1]
    deviation = np.sqrt(np.maximum(np.broadcast_to(within_nm2, axes), 0.0))
    signs = np.array(list(product((-1.0, 1.0), repeat=axes))) if np.any(deviation) else [0.0]
    away = series - series.mean(axis=0)
    distance = np.concatenate([np.linalg.norm(away + sign * deviation, axis=1) for sign in signs])
    image = _annular_image(imaging.cycles_per_nm * distance, imaging.obstruction)
    return float(imaging.other_modes * min(float(np.mean(image)), 1.0))


def _annular_image(distance: FloatArray, obstruction: float) -> FloatArray:
    """Image of a star through an annular pupil over its peak, at distances in lambda / D."""

    def disc(u: FloatArray) -> FloatArray:
        """``2 J1(u) / u``."""
        return np.asarray(2 * j1(u) / np.where(u > 0, u, 1.0) + (u == 0))

    u, eps = np.pi * distance, obstruction
    return np.asarray(((disc(u) - eps**2 * disc(eps * u)) / (1 - eps**2)) ** 2)


def _require_axes(size: int) -> None:
    if size not in (1, 2):
        raise DimensionError(f"a Strehl ratio of jitter takes 1 or 2 axes; got {size} modes.")


@lru_cache(maxsize=32)
def _radial_otf(obstruction: float, fineness: int) -> tuple[FloatArray, FloatArray]:
    """Radii [D/lambda] and OTF weights of sum 1 of rings of the plane."""
    eps = obstruction
    kinks = {0.0, 0.1, 0.3, eps, (1 - eps) / 2, (1 + eps) / 2, 1.0}
    edges = np.array(sorted(kinks))
    for _ in range(fineness):
        edges = np.sort(np.concatenate([edges, (edges[1:] + edges[:-1]) / 2]))
    # at a kink the OTF grows by a power of 3/2, and the nodes crowd there by a cubic
    t, share = gauss_panels(np.array([0.0, 1.0]), 16)
    steps = np.diff(edges)[:, None]
    radius = (edges[:-1, None] + steps * t**2 * (3 - 2 * t)).ravel()
    weight = (steps * 6 * t * (1 - t) * share).ravel() * radius * annular_otf(radius, eps)
    weight /= weight.sum()
    if count := _FEW_RADII.get(fineness):  # G. H. Golub, J. H. Welsch, Math. Comp. 23, 221 (1969)
        root, square = np.sqrt(weight), radius**2
        basis, _ = np.linalg.qr(root[:, None] * chebvander(2 * square - 1, count - 1))
        square, vectors = np.linalg.eigh(basis.T @ (square[:, None] * basis))
        radius, weight = np.sqrt(square), (root @ basis @ vectors) ** 2
    return radius, weight


@lru_cache(maxsize=32)
def _weighted_otf(obstruction: float, fineness: int) -> tuple[FloatArray, FloatArray]:
    """Nodes in half the plane, (fx^2, 2 fx fy, fy^2) [(D/lambda)^2], and OTF weights of sum 1."""
    radius, weight = _radial_otf(obstruction, fineness)
    directions = int(_DIRECTIONS * 2.0**fineness)
    angle = np.pi * (np.arange(directions) + 0.5) / directions
    fx, fy = np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()
    weights = np.repeat(weight / angle.size, angle.size)
    return np.stack([fx**2, 2 * fx * fy, fy**2]), weights


def annular_otf(radius: FloatArray, obstruction: float) -> FloatArray:
    """Transfer function of an annular pupil at radius f lambda / D: the overlap of two annuli."""
    rho, eps = np.asarray(radius, dtype=np.float64), obstruction
    overlap = _lens(rho, 0.5, 0.5)
    if eps > 1e-8:  # the area of a smaller one is rounding
        overlap = overlap - 2 * _lens(rho, 0.5, eps / 2) + _lens(rho, eps / 2, eps / 2)
    return np.asarray(overlap / (np.pi / 4 * (1 - eps**2)))


def _lens(distance: FloatArray, large: float, small: float) -> FloatArray:
    """Area common to two discs of radii large >= small at a distance."""
    d = np.clip(distance, max(large - small, 1e-300), large + small)
    cos_large = np.clip((d**2 + large**2 - small**2) / (2 * d * large), -1, 1)
    cos_small = np.clip((d**2 + small**2 - large**2) / (2 * d * small), -1, 1)
    kite = (-d + small + large) * (d + small - large) * (d - small + large) * (d + small + large)
    sectors = large**2 * np.arccos(cos_large) + small**2 * np.arccos(cos_small)
    area = sectors - np.sqrt(np.maximum(kite, 0)) / 2
    return np.asarray(np.where(distance <= large - small, np.pi * small**2, area))
