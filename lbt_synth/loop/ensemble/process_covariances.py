"""Residuals that auto-regressive processes leave in many loops, by Lyapunov equations."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop.ensemble.closed_loops import LoopGroup
from lbt_synth.models import ARModel, ModalTurbulence
from lbt_synth.validation import FloatArray, IntArray

Process: TypeAlias = ARModel | ModalTurbulence
_RESIDUAL = 1e-9  # of a Lyapunov equation, relative


def add_process(
    total: FloatArray,
    rows: IntArray,
    groups: list[LoopGroup],
    process: Process,
    along: FloatArray,
    known: dict[tuple[bytes, ...], FloatArray],
) -> None:
    """Add to ``total[rows]`` (p, n, n) what a process leaves in all subloops that it reaches.

    The direction ``along`` is (n,), or (l k, n) for l processes of all loops in turn.
    """
    reached = [group for group in groups if np.any(along[..., group.subloop.modes])]
    if reached:
        modes = np.concatenate([group.subloop.modes for group in reached])
        at = (rows[:, None, None], *np.ix_(modes, modes))
        turns = len(along) // rows.size if along.ndim == 2 else 1
        loops = tuple(np.tile(part, (turns, 1, 1)) for part in _join(reached))
        own = along[..., modes]
        numbers = (*loops, process.coefficients, process.driving_rms_nm, own)
        key = tuple(np.asarray(part).tobytes() for part in numbers)
        if key not in known:
            known[key] = _process_covariances(loops, process, own)
        found = known[key].reshape(turns, rows.size, modes.size, modes.size)
        total[at] += np.sum(found, axis=0)


def _join(groups: list[LoopGroup]) -> tuple[FloatArray, ...]:
    """Matrices ``A, B, C, D`` of independent subloops as one, driven by the total phase only."""
    n = [group.C.shape[1] for group in groups]
    parts = [(g.A, g.B[..., :m], g.C, g.D[..., :m]) for g, m in zip(groups, n, strict=True)]
    if len(parts) == 1:
        return parts[0]
    states = np.cumsum([0] + [group.A.shape[1] for group in groups])
    modes, count = np.cumsum([0, *n]), len(groups[0].A)
    A, B = np.zeros((count, states[-1], states[-1])), np.zeros((count, states[-1], modes[-1]))
    C, D = np.zeros((count, modes[-1], states[-1])), np.zeros((count, modes[-1], modes[-1]))
    for i, part in enumerate(parts):
        x, r = slice(*states[i : i + 2]), slice(*modes[i : i + 2])
        A[:, x, x], B[:, x, r], C[:, r, x], D[:, r, r] = part
    return A, B, C, D


def _process_covariances(
    loops: tuple[FloatArray, ...], process: Process, directions: FloatArray
) -> FloatArray:
    """Covariance (k, n, n) of the residual that a process, or one per loop, leaves.

    ``directions`` is (n,), or (k, n) with one per loop.
    """
    if isinstance(process, ARModel):
        coefficients, drive = process.coefficients[None], np.array([process.driving_rms_nm])
    else:
        coefficients, drive = process.coefficients, process.driving_rms_nm
    entry, through = loops[1], loops[3]
    order, (k, s, n) = coefficients.shape[1], entry.shape
    along = np.broadcast_to(directions, (k, n))[:, :, None]
    A, Q = np.zeros((2, k, s + order, s + order))
    A[:, :s, :s] = loops[0]
    A[:, :s, s : s + 1] = entry @ along  # the newest sample acts on its frame
    A[:, s, s:] = coefficients
    A[:, s + 1 :, s:-1] = np.eye(order - 1)
    Q[:, s, s] = drive**2
    C = np.zeros((k, n, s + order))
    C[..., :s], C[..., s : s + 1] = loops[2], through @ along
    X, residuals = stationary_covariances(A, Q)
    if not np.all(residuals < _RESIDUAL):
        worst = float(np.max(np.nan_to_num(residuals, nan=np.inf)))
        raise ProblemError(
            "the covariance of a process in a loop was not found: its Lyapunov equation has the "
            f"relative residual {worst:.3g}. The process or the loop is nearly a random "
            "walk; damp it."
        )
    return np.asarray(C @ X @ transpose(C))
