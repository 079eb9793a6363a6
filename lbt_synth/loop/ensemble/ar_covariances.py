"""Residuals that auto-regressive processes leave in batched loops, by Lyapunov equations."""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear.batched import transpose
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.loop.ensemble.batched_loops import BatchedLoops, join_subloops
from lbt_synth.models import ARModel, ModalTurbulence
from lbt_synth.validation import FloatArray, IntArray

PROCESSES = (ARModel, ModalTurbulence)
_RESIDUAL = 1e-9  # of a Lyapunov equation, relative


def _process_covariances(
    loops: BatchedLoops, process: ARModel | ModalTurbulence, directions: FloatArray
) -> FloatArray:
    """Covariance (k, n, n) of the residual that a process, or one per loop, leaves.

    ``directions`` is (n,), or (k, n) with one per loop.
    """
    if isinstance(process, ARModel):
        coefficients, drive = process.coefficients[None], np.array([process.driving_rms_nm])
    else:
        coefficients, drive = process.coefficients, process.driving_rms_nm
    order, s, k = coefficients.shape[1], loops.A.shape[1], len(loops.A)
    n = loops.C.shape[1]
    along = np.broadcast_to(directions, (k, n))[:, :, None]
    A = np.zeros((k, s + order, s + order))
    A[:, :s, :s] = loops.A
    A[:, :s, s : s + 1] = loops.B[..., :n] @ along  # the newest sample acts on its frame
    A[:, s, s:] = coefficients
    A[:, s + 1 :, s:-1] = np.eye(order - 1)
    Q = np.zeros_like(A)
    Q[:, s, s] = drive**2
    C = np.zeros((k, n, s + order))
    C[..., :s] = loops.C
    C[..., s : s + 1] = loops.D[..., :n] @ along
    X, residuals = stationary_covariances(A, Q)
    if not np.all(residuals < _RESIDUAL):
        worst = float(np.max(np.nan_to_num(residuals, nan=np.inf)))
        raise ProblemError(
            "the covariance of a process in a loop was not found: its Lyapunov equation has the "
            f"relative residual {worst:.3g}. The process or the loop is nearly a random "
            "walk; damp it."
        )
    return np.asarray(C @ X @ transpose(C))


def add_process(
    total: FloatArray,
    rows: IntArray,
    loops: list[tuple[IntArray, BatchedLoops]],
    process: ARModel | ModalTurbulence,
    direction: FloatArray,
) -> None:
    """Add to ``total[rows]`` (p, n, n) what a process leaves in all subloops that it reaches.

    ``loops`` holds the modes and the loops (k) of each subloop; ``direction`` is (n,) or (k, n).
    """
    reached = [(modes, batch) for modes, batch in loops if np.any(direction[..., modes])]
    if not reached:
        return
    modes = np.concatenate([modes for modes, _ in reached])
    joined = join_subloops([batch for _, batch in reached])
    at = (rows[:, None, None], *np.ix_(modes, modes))
    total[at] += _process_covariances(joined, process, direction[..., modes])
