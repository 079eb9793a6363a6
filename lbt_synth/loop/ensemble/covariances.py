"""Residuals that turbulence, noise and vibrations leave in many loops.

Spectra and noise go through quadrature, auto-regressive processes through Lyapunov equations,
sinusoids through the loops' responses.
"""

from __future__ import annotations

from itertools import chain
from typing import TypeAlias

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear.batched import transpose
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.loop.closed_loop import require_loop_rate
from lbt_synth.loop.ensemble.closed_loops import ClosedLoops, LoopGroup
from lbt_synth.loop.ensemble.loop_ensemble import EnsembleVibration, Turbulence, turbulence_rows
from lbt_synth.loop.ensemble.spectral_covariances import spectral_covariances
from lbt_synth.models import ARModel, ModalTurbulence
from lbt_synth.models.vibration.resonance import sampled_lines
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

Process: TypeAlias = ARModel | ModalTurbulence
_RESIDUAL = 1e-9  # of a Lyapunov equation, relative
_AT_ONCE = 1024  # loops with vibrations


def turbulence_and_noise_nm2(
    loops: ClosedLoops, turbulence: list[tuple[Turbulence, tuple[int, ...]]], noise_nm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances (p, n, n) of the residual from turbulence, and from noise (p, q).

    ``turbulence`` pairs each spectrum with its modes. Unstable loops have nan.
    """
    hardware, stable = loops.hardware, loops.stable
    for spectrum, _ in turbulence:
        if isinstance(spectrum, Process):
            require_loop_rate(spectrum.frame_rate_hz, hardware)
    n, rate = hardware.modes, hardware.frame_rate_hz
    turbulence_nm2, noise_nm2 = np.full((2, stable.size, n, n), np.nan)
    turbulence_nm2[stable], noise_nm2[stable] = 0.0, 0.0
    spectra = [pair for pair in turbulence if not isinstance(pair[0], Process)]
    for group in chain.from_iterable(loops.subloops):
        for batch in group.batches(stable):
            own = batch.subloop.modes
            smooth = []
            for spectrum, modes in spectra:
                places = np.flatnonzero(np.isin(own, modes)).tolist()
                if places:
                    smooth.append((turbulence_rows(spectrum, batch.rows), places))
            at = (batch.rows[:, None, None], *np.ix_(own, own))
            noise = noise_nm[batch.rows][:, batch.subloop.measurements]
            turbulence_nm2[at], noise_nm2[at] = spectral_covariances(batch, smooth, noise, rate)
    for spectrum, modes in turbulence:
        if not isinstance(spectrum, Process):
            continue
        for same_delay in zip(*loops.subloops, strict=True):
            found = np.flatnonzero(stable[same_delay[0].rows])
            if found.size:
                chosen = [group.take(found) for group in same_delay]
                process = turbulence_rows(spectrum, chosen[0].rows)
                assert isinstance(process, Process)
                for mode in modes:
                    axis = np.eye(n)[mode]
                    _add_process(turbulence_nm2, chosen[0].rows, chosen, process, axis)
    return turbulence_nm2, noise_nm2


def vibration_residuals(
    loops: ClosedLoops, which: IntArray, lines: list[EnsembleVibration]
) -> tuple[FloatArray, ComplexArray]:
    """Covariances (p, n, n) from resonances, and amplitudes (p, s, n) that sinusoids leave.

    ``which`` (p,) is the closed loop of each row of the vibrations.
    """
    n, count, rate = loops.hardware.modes, which.size, loops.hardware.frame_rate_hz
    stable = loops.stable[which]
    random = [line for line in lines if line.damping is not None]
    sinusoids = [line for line in lines if line.damping is None]
    random_nm2 = np.full((count, n, n), np.nan)
    amplitudes_nm = np.full((count, len(sinusoids), n), np.nan + 0j)
    random_nm2[stable], amplitudes_nm[stable] = 0.0, 0.0
    for groups in zip(*loops.subloops, strict=True):
        place = np.full(loops.stable.size, -1)
        place[groups[0].rows] = np.arange(groups[0].rows.size)
        found = np.flatnonzero(stable & (place[which] >= 0))
        for rows in (found[i : i + _AT_ONCE] for i in range(0, found.size, _AT_ONCE)):
            chosen = [group.take(place[which[rows]]) for group in groups]
            for i, line in enumerate(sinusoids):
                peak = line.direction[rows] * np.sqrt(2) * line.rms_nm[rows][:, None]
                turn = 2 * np.pi * line.frequency_hz[rows] / rate
                for group in chosen:
                    modes = group.subloop.modes
                    left = group.rejections(turn) @ peak[:, modes, None]
                    amplitudes_nm[rows[:, None], i, modes] = left[..., 0]
            for line in random:
                numbers = line.frequency_hz[rows], line.damping[rows], line.rms_nm[rows]
                a, drive = sampled_lines(*numbers, rate)
                process = ModalTurbulence(coefficients=a, driving_rms_nm=drive, frame_rate_hz=rate)
                _add_process(random_nm2, rows, chosen, process, line.direction[rows])
    return random_nm2, amplitudes_nm


def _add_process(
    total: FloatArray, rows: IntArray, groups: list[LoopGroup], process: Process, along: FloatArray
) -> None:
    """Add to ``total[rows]`` (p, n, n) what a process leaves in all subloops that it reaches.

    The direction ``along`` is (n,), or (k, n) with one per loop.
    """
    reached = [group for group in groups if np.any(along[..., group.subloop.modes])]
    if reached:
        modes = np.concatenate([group.subloop.modes for group in reached])
        at = (rows[:, None, None], *np.ix_(modes, modes))
        total[at] += _process_covariances(_join(reached), process, along[..., modes])


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
