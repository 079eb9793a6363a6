"""Closed loops of many controllers, and the variances that they leave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lbt_synth.design.modal.banks import Bank
from lbt_synth.design.modal.plants import Lines, disturbances
from lbt_synth.linear.batched import transpose
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.loop.closed_loop import loop_matrices
from lbt_synth.models import ModalTurbulence
from lbt_synth.models.mirror.frame_rate_system import Response
from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LoopBlock:
    """Closed loops of one bank, from ``[phi_tot, noise]`` to ``[phi_res, u]``."""

    modes: np.ndarray  # (N, w), modes of each loop
    A: FloatArray  # (N, s, s)
    B: FloatArray  # (N, s, 2 w)
    C: FloatArray  # (N, 2 w, s)
    D: FloatArray  # (N, 2 w, 2 w)


def close_bank(bank: Bank, sensor_gain: FloatArray, mirror: Response) -> LoopBlock:
    """Close the loops of a bank, with the sensor gain (n,) of every mode.

    A controller of several modes is alone in its bank, or all its modes have one gain.
    """
    w = bank.width
    unit = np.eye(w)
    if w == 1:
        sensor, factor = unit, sensor_gain[bank.modes][:, :, None]
    else:
        sensor, factor = np.diag(sensor_gain[bank.modes[0]]), np.ones((1, 1, 1))
    textbook = bank.A, bank.B, bank.C @ bank.A, bank.C @ bank.B + bank.D
    A0, A1, B, C0, C1, D = loop_matrices(*textbook, mirror=mirror, sensor=sensor, influence=unit)
    part = slice(2 * w)  # the measurement is left out
    C = C0[:, part] + factor * C1[:, part]
    return LoopBlock(bank.modes, A0 + factor * A1, B, C, D[:, part])


def spectral_radii(A: FloatArray) -> FloatArray:
    """Largest modulus of the eigenvalues of each matrix of a stack, (N,)."""
    return np.asarray(np.abs(np.linalg.eigvals(A)).max(axis=-1))


class LoopVariances(NamedTuple):
    """What the loops of a block leave, with what tells how far it can be trusted."""

    variances: FloatArray  # (N, w), of each mode's residual
    residuals: FloatArray  # (N,), relative, of the Lyapunov equations
    rounding: FloatArray  # (N,), what it may have done to the variances, relative


def block_variances(
    block: LoopBlock, turbulence: ModalTurbulence, lines: Lines, noise_nm: FloatArray
) -> LoopVariances:
    """Exact variances under models and white noise: Lyapunov equations of loops and models.

    The variances are small differences where a process is nearly a random walk.
    """
    count, w = block.modes.shape
    n = block.A.shape[-1]
    d = disturbances(turbulence, lines, block.modes.ravel())
    k, p = d.B.shape[1:]
    rows = d.row.reshape(count, w, 1, k)
    models, drives = d.A.reshape(count, w, k, k), d.B.reshape(count, w, k, p)
    A = np.zeros((count, n + w * k, n + w * k))
    B = np.zeros((count, n + w * k, w + w * p))
    C, D = np.zeros((count, w, n + w * k)), np.zeros((count, w, w + w * p))
    noise = noise_nm[block.modes][:, None, :]
    A[:, :n, :n], C[..., :n] = block.A, block.C[:, :w]
    B[:, :n, :w], D[..., :w] = block.B[..., w:] * noise, block.D[:, :w, w:] * noise
    for i in range(w):
        x, v = slice(n + i * k, n + (i + 1) * k), slice(w + i * p, w + (i + 1) * p)
        A[:, :n, x] = block.B[..., i : i + 1] @ rows[:, i]
        C[..., x] = block.D[:, :w, i : i + 1] @ rows[:, i]
        A[:, x, x], B[:, x, v] = models[:, i], drives[:, i]
    P, residuals = stationary_covariances(A, B @ transpose(B))
    output = C @ P @ transpose(C) + D @ transpose(D)
    variances = np.diagonal(output, axis1=-2, axis2=-1).copy()
    sizes = np.abs(C) @ np.abs(P) @ np.abs(transpose(C))
    sizes = np.diagonal(sizes, axis1=-2, axis2=-1) + np.sum(D**2, axis=-1)
    small = np.finfo(float).tiny  # no disturbance: 0, and nothing is lost
    rounding = np.finfo(float).eps * np.max(sizes / np.maximum(variances, small), axis=-1)
    return LoopVariances(variances, residuals, np.asarray(rounding))
