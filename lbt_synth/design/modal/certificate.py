"""The certificate of the filters of many modes, by other means than the Riccati equation."""

from __future__ import annotations

import numpy as np

from lbt_synth.design.certificate import (
    GAIN_TOLERANCE,
    RESIDUAL_TOLERANCE,
    VARIANCE_TOLERANCE,
    Certificate,
    Check,
)
from lbt_synth.design.modal.closed_loops import LoopBlock, LoopVariances, spectral_radii
from lbt_synth.design.modal.plants import PlantBatch
from lbt_synth.design.modal.reconstructor import name_modes
from lbt_synth.linear import DareSolution
from lbt_synth.linear.batched import frobenius_norms, transpose
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.validation import FloatArray, frozen_copy

_STABLE = 1 - STABILITY_MARGIN
_SQUARING = "relative, by squaring"
_CHECKS = (  # what is checked, its limit, how it is computed
    ("spectral radius of the filter", _STABLE, "eigenvalues"),
    ("spectral radius of the closed loop", _STABLE, "eigenvalues"),
    ("residual of the Riccati equation", RESIDUAL_TOLERANCE, "relative, in extended precision"),
    ("residual of the Lyapunov equation", RESIDUAL_TOLERANCE, _SQUARING),
    ("variance, against the Riccati equation", VARIANCE_TOLERANCE, "relative, Lyapunov equation"),
    (
        "distance from the least-variance gain",
        GAIN_TOLERANCE,
        "gain recomputed from the Lyapunov covariance",
    ),
    ("residual of the loop's Lyapunov equation", RESIDUAL_TOLERANCE, _SQUARING),
)
_APPLIED = (  # the residual is the estimation error
    "residual of the closed loop, against the estimation error",
    VARIANCE_TOLERANCE,
    "relative, two Lyapunov equations",
)
_NOT_APPLIED = (
    "rounding in the residual of the closed loop",
    VARIANCE_TOLERANCE,
    "relative, sizes of the terms of its variance",
)


def batch_errors(
    batch: PlantBatch,
    gains: FloatArray,
    solution: DareSolution,
    loops: tuple[LoopBlock, LoopVariances],
    *,
    applied: bool,
) -> tuple[FloatArray, FloatArray]:
    """Numbers to be checked of some filters and their loops, (8, N), and estimation variances.

    ``applied``: the loops apply the estimate itself, at once and a whole delay later.
    """
    block, left = loops
    A, drive = batch.error_systems(gains)
    P, residuals = stationary_covariances(A, drive)
    lyapunov = (batch.L @ P @ transpose(batch.L))[:, 0, 0]
    riccati = (batch.L @ solution.X @ transpose(batch.L))[:, 0, 0]
    seen = P @ transpose(batch.C)
    optimal = batch.A @ seen / (batch.R + batch.C @ seen)
    size = frobenius_norms(optimal)
    last = np.abs(left.variances[:, 0] - lyapunov) / lyapunov if applied else left.rounding
    rows = (
        spectral_radii(A),
        spectral_radii(block.A),
        solution.residuals,
        residuals,
        np.abs(lyapunov - riccati) / riccati,
        frobenius_norms(gains - optimal) / np.where(size > 0, size, 1.0),
        left.residuals,
        last,
    )
    return np.stack(rows), lyapunov


def modal_certificate(
    errors: FloatArray, estimation_nm2: FloatArray, *, applied: bool
) -> Certificate:
    """Check the worst mode of everything, (8, n); a check that fails names all modes that do."""
    kinds = (*_CHECKS, _APPLIED if applied else _NOT_APPLIED)
    checks = []
    for (name, limit, computed_by), values in zip(kinds, errors, strict=True):
        failing = np.flatnonzero(~(values < limit))
        text = f"{name} ({name_modes(failing)})" if failing.size else name
        checks.append(Check(text, float(np.max(values)), limit, computed_by))
    rms = frozen_copy(np.sqrt(np.maximum(estimation_nm2, 0)))
    return Certificate(checks=tuple(checks), gamma=np.nan, rms_per_output=rms)
