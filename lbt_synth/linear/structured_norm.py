"""The structured norm of a square system, whose channels are uncertain one by one.

The structured singular value mu of a matrix M is one over the size of the smallest diagonal
Delta that makes ``I - M Delta`` singular. A diagonal scaling D bounds it from above,
``mu(M) <= sigma(D M D^-1)``, and the best one attains it for two channels: A. Packard, J. Doyle,
Automatica 29, 71 (1993), doi:10.1016/0005-1098(93)90175-S. On a grid of frequencies that says
nothing of what lies between. Here each scaling serves an interval, as far as the level sets of
the scaled system reach, and the intervals cover all frequencies.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.linear.norms import HinfNorm, fold_angles, hinf_norm, level_angles
from lbt_synth.linear.state_space import StateSpace, pointwise_response
from lbt_synth.validation import ComplexArray, FloatArray

_GAP = 1e-4  # relative, between the bound and the largest value found
_GRID = 129
_SWEEPS = 10  # of the scaling, over all channels
_MOST_RATIO = 1e8  # of scales, where nothing comes back from a channel
_MOST_INTERVALS = 5000
_POINT = 1e-12  # a narrower interval is a point


def structured_norm(system: StateSpace) -> HinfNorm:
    """Bound the structured singular value over all frequencies, channels uncertain one by one.

    Parameters
    ----------
    system : StateSpace
        A stable system with as many inputs as outputs.

    Returns
    -------
    HinfNorm
        A diagonal uncertainty of norm below ``1 / upper`` leaves the loop around the system
        stable: ``upper`` holds at all frequencies. ``value`` is the largest bound found at one
        frequency; for two channels it is attained.

    Raises
    ------
    ProblemError
        If the system is not square.
    UnstableLoopError
        If it is not stable.
    NumericalError
        If the intervals do not cover all frequencies.

    Examples
    --------
    Two channels that are coupled one way are as safe as each by itself:

    >>> import lbt_synth as lbt
    >>> one_way = lbt.linear.StateSpace(
    ...     A=[[0.5]], B=[[0.0, 9.0]], C=[[1.0], [0.0]], D=[[1.0, 0.0], [0.0, 2.0]]
    ... )
    >>> round(float(lbt.hinf_norm(one_way)), 1)
    18.1
    >>> round(float(lbt.linear.structured_norm(one_way)), 6)
    2.0
    """
    channels = len(system.C)
    if channels != system.B.shape[1]:
        raise ProblemError(
            "a structured norm needs as many outputs as inputs; got "
            f"{channels} outputs for {system.B.shape[1]} inputs."
        )
    whole = hinf_norm(system)
    if channels == 1 or whole.value == 0:
        return whole
    seeds = np.concatenate([np.linspace(0, np.pi, _GRID), np.angle(system.poles)])
    peak, angle = max(_scaled_size(system, float(each)) for each in fold_angles(seeds, 0, np.pi))
    open_intervals = [(0.0, np.pi)]
    for _ in range(_MOST_INTERVALS):
        if not open_intervals:
            value = min(peak, whole.value)
            return replace(
                whole,
                value=value,
                lower=value,
                upper=min(peak * (1 + _GAP), whole.upper),
                peak_frequency_hz=angle / (2 * np.pi * system.dt_s),
            )
        low, high = open_intervals.pop()
        middle = (low + high) / 2
        peak, angle = max((peak, angle), _scaled_size(system, middle))
        left, right = _reach(system, middle, peak * (1 + _GAP), low, high)
        open_intervals += [(a, b) for a, b in ((low, left), (right, high)) if b - a > _POINT]
    raise NumericalError(
        f"the structured norm is at least {peak:.6g}, but its bound does not close with "
        f"{_MOST_INTERVALS} intervals of frequency. Balance the states of the system.",
        status="level sets",
    )


def _reach(
    system: StateSpace, angle: float, level: float, low: float, high: float
) -> tuple[float, float]:
    """Return the ends of the interval around an angle on which its scaling stays below a level."""
    scales = _scales(_response(system, angle))
    scaled = StateSpace(
        A=system.A,
        B=system.B / scales,
        C=scales[:, None] * system.C,
        D=scales[:, None] * system.D / scales,
        dt_s=system.dt_s,
    )
    angles = fold_angles(level_angles(scaled.balanced(), level), low, high)
    return float(angles[angles < angle].max()), float(angles[angles > angle].min())


def _scaled_size(system: StateSpace, angle: float) -> tuple[float, float]:
    """Return the largest singular value at an angle after the best scaling, and the angle."""
    response = _response(system, angle)
    scales = _scales(response)
    return float(np.linalg.norm(scales[:, None] * response / scales, 2)), angle


def _response(system: StateSpace, angle: float) -> ComplexArray:
    response = pointwise_response(system, np.exp(1j * np.array([angle])))
    return np.asarray(response[0])


def _scales(matrix: ComplexArray) -> FloatArray:
    """Return diagonal scales that make rows and columns off the diagonal alike.

    They minimise the Frobenius norm (E. E. Osborne, J. ACM 7, 338 (1960),
    doi:10.1145/321043.321048), and for two channels, whose determinant no scaling changes, the
    largest singular value as well.
    """
    size = np.abs(matrix)
    np.fill_diagonal(size, 0.0)
    tiny = max(float(size.max()) / _MOST_RATIO, np.finfo(float).tiny)
    scales = np.ones(len(matrix))
    for _ in range(_SWEEPS):
        for i in range(len(matrix)):
            row = float(np.linalg.norm(scales[i] * size[i] / scales))
            column = float(np.linalg.norm(scales * size[:, i] / scales[i]))
            scales[i] *= np.sqrt(max(column, tiny) / max(row, tiny))
    return np.asarray(np.clip(scales / scales.max(), 1 / _MOST_RATIO, 1.0))
