"""Bounds of the structured singular value of a matrix, or of a system over all frequencies.

A grid of frequencies says nothing of what lies between. Here each pair of scales serves an
interval, as far as the level sets of the scaled system reach, and the intervals cover all
frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.linear.norms import fold_angles, hinf_norm, popov_angles
from lbt_synth.linear.state_space import StateSpace, pointwise_response
from lbt_synth.linear.structured_singular_value.blocks import Block, checked_blocks
from lbt_synth.linear.structured_singular_value.power_iteration import destabilising_delta
from lbt_synth.linear.structured_singular_value.scales import Scales, best_scales
from lbt_synth.validation import ComplexArray, number, real_array

_GRID = 65
_MOST_INTERVALS = 5000
_POINT = 1e-12  # a narrower interval is a point
_TRIED = 5  # frequencies at which an uncertainty is sought
_APART = 1e-3  # of them, at least [rad per sample]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MuBound:
    """Bounds of the structured singular value mu.

    Attributes
    ----------
    upper : float
        No uncertainty of these blocks of norm below ``1 / upper`` destabilises: proved, for a
        system at all frequencies.
    lower : float
        One over the norm of ``delta``, which does; 0 where none was found.
    frequency_hz : float
        Frequency at which ``upper`` (but for the tolerance) was found; nan for a matrix.
    scales : Scales
        The scales that prove the upper bound there.
    delta : (q, p) complex ndarray or None
        The smallest uncertainty found that makes ``I - M delta`` singular.
    delta_frequency_hz : float
        Its frequency.
    """

    upper: float
    lower: float
    frequency_hz: float
    scales: Scales
    delta: ComplexArray | None
    delta_frequency_hz: float


def mu_bound(system: Any, blocks: Sequence[Block], *, tolerance: float = 1e-3) -> MuBound:
    """Bound the structured singular value of a matrix, or of a system at all frequencies.

    Parameters
    ----------
    system : (p, q) array_like, StateSpace, control.StateSpace or tuple (A, B, C, D)
        A complex matrix, or a stable system in discrete time.
    blocks : sequence of Block
        The uncertainty from its outputs to its inputs, in their order.
    tolerance : float, optional
        Relative distance of ``upper`` from the largest bound at one frequency, at least 1e-6.

    Returns
    -------
    MuBound
        Both bounds, and what proves them.

    Raises
    ------
    ProblemError
        If the blocks do not match the system.
    UnstableLoopError
        If the system is not stable.
    NumericalError
        If the intervals do not cover all frequencies.

    References
    ----------
    A. Packard, J. Doyle, Automatica 29, 71 (1993), doi:10.1016/0005-1098(93)90175-S.

    Examples
    --------
    Two channels that are coupled one way are as safe as each by itself:

    >>> import lbt_synth as lbt
    >>> two = (lbt.linear.Block(), lbt.linear.Block())
    >>> found = lbt.linear.mu_bound([[1.0, 9.0], [0.0, 2.0]], two)
    >>> round(found.upper, 6), round(found.lower, 6)
    (2.0, 2.0)
    """
    number(tolerance, "tolerance", at_least=1e-6, at_most=1)
    if not isinstance(system, StateSpace | tuple) and not hasattr(system, "dt"):
        constant = np.atleast_2d(np.asarray(system, dtype=complex))
        real_array(np.abs(constant), "system")  # refuses what is not finite
        return _matrix_bound(constant, blocks)
    G = StateSpace.of(system)
    given = checked_blocks(blocks, G.D.shape)
    upper, angles = upper_bound(G, given, tolerance)
    first = _matrix_bound(_response(G, angles[0]), given)
    found, where = first, angles[0]
    for angle in angles[1:]:
        other = _matrix_bound(_response(G, angle), given)
        if other.lower > found.lower:
            found, where = other, angle
    unit = 2 * np.pi * G.dt_s
    return MuBound(
        upper=upper,
        lower=found.lower,
        frequency_hz=angles[0] / unit,
        scales=first.scales,
        delta=found.delta,
        delta_frequency_hz=where / unit,
    )


def _matrix_bound(matrix: ComplexArray, blocks: Sequence[Block]) -> MuBound:
    given = checked_blocks(blocks, matrix.shape)
    scales = best_scales(matrix, given)
    upper = scales.bound(matrix)
    delta = destabilising_delta(matrix, given, scales)
    lower = 0.0 if delta is None else float(1 / np.linalg.norm(delta, 2))
    return MuBound(
        upper=upper,
        lower=min(lower, upper),  # delta is as good as rounding lets it be
        frequency_hz=np.nan,
        scales=scales,
        delta=delta,
        delta_frequency_hz=np.nan,
    )


def upper_bound(
    system: StateSpace, blocks: Sequence[Block], tolerance: float
) -> tuple[float, list[float]]:
    """Return the bound at all frequencies, and the angles at which it is largest."""
    whole = hinf_norm(system)
    if whole.value == 0:
        return 0.0, [0.0]
    if len(blocks) == 1 and blocks[0].kind == "full":
        return whole.upper, [2 * np.pi * whole.peak_frequency_hz * system.dt_s]
    balanced = system.balanced()
    values: dict[float, float] = {}
    peak = 0.0

    def scales_at(angle: float) -> Scales:
        """Return scales that serve an angle at the level of the peak, which may rise."""
        nonlocal peak
        response = _response(system, angle)
        scales = best_scales(response, blocks, peak * (1 + tolerance))
        values[angle] = scales.bound(response)
        peak = max(peak, values[angle])
        return scales

    seeds = np.concatenate([np.linspace(0, np.pi, _GRID), np.angle(system.poles)])
    seeds = fold_angles(seeds, 0, np.pi)
    responses = pointwise_response(system, np.exp(1j * seeds))
    for i in np.argsort(-np.linalg.norm(responses, 2, axis=(1, 2))):
        scales_at(float(seeds[i]))
    # the ends first, where real blocks are worst and nothing lies beyond
    first, last = scales_at(0.0), scales_at(np.pi)
    level = peak * (1 + tolerance)
    start = _reach(balanced, first, 0.0, level, 0.0, np.pi)[1]
    end = _reach(balanced, last, np.pi, level, start, np.pi)[0] if start < np.pi else np.pi
    intervals = [(start, end)] if end - start > _POINT else []
    for _ in range(_MOST_INTERVALS):
        if not intervals:
            return min(peak * (1 + tolerance), whole.upper), _largest_apart(values)
        low, high = intervals.pop()
        middle = (low + high) / 2
        scales = scales_at(middle)
        left, right = _reach(balanced, scales, middle, peak * (1 + tolerance), low, high)
        intervals += [(a, b) for a, b in ((low, left), (right, high)) if b - a > _POINT]
    raise NumericalError(
        f"the structured singular value is bounded by {peak:.6g} where it was computed, but the "
        f"bound does not close with {_MOST_INTERVALS} intervals of frequency. Try a larger "
        "tolerance.",
        status="level sets",
    )


def _largest_apart(values: dict[float, float]) -> list[float]:
    """Return the angles of the largest values that are not next to one another."""
    kept: list[float] = []
    for angle in sorted(values, key=lambda angle: -values[angle]):
        if len(kept) < _TRIED and all(abs(angle - other) > _APART for other in kept):
            kept.append(angle)
    return kept


def _reach(
    system: StateSpace, scales: Scales, angle: float, level: float, low: float, high: float
) -> tuple[float, float]:
    """Return the ends of the interval around an angle on which scales stay below a level."""
    L, R_inverse = scales.factors()
    G = R_inverse.conj().T @ scales.skew @ np.linalg.inv(L) / level
    root = np.sqrt(level)
    B, C, D = system.B @ R_inverse / root, L @ system.C / root, L @ system.D @ R_inverse / level
    Q, S, R = C.conj().T @ C, D.conj().T @ C, D.conj().T @ D - np.eye(D.shape[1])
    if G.any():
        S = S + 1j * G @ C
        R = R + 1j * (G @ D - (G @ D).conj().T)
    if any(np.iscomplex(part).any() for part in (B, Q, S, R)):
        crossings = popov_angles(system.A, B, Q, S, R)
    else:
        crossings = popov_angles(system.A, B.real, Q.real, S.real, R.real)
    angles = fold_angles(crossings, low, high)
    below, above = angles[angles < angle], angles[angles > angle]
    return float(below.max(initial=low)), float(above.min(initial=high))


def _response(system: StateSpace, angle: float) -> ComplexArray:
    return np.asarray(pointwise_response(system, np.exp(1j * np.array([angle])))[0])
