"""Residuals that vibrations leave in many loops: sinusoids and damped resonances."""

from __future__ import annotations

import numpy as np

from lbt_synth.loop.ensemble.ar_covariances import add_process
from lbt_synth.loop.ensemble.closed_loops import ClosedLoops
from lbt_synth.loop.ensemble.loop_ensemble import EnsembleVibration
from lbt_synth.models import ModalTurbulence
from lbt_synth.models.vibration.resonance import sampled_lines
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

_AT_ONCE = 1024  # loops


def vibration_residuals(
    loops: ClosedLoops, which: IntArray, lines: list[EnsembleVibration]
) -> tuple[FloatArray, ComplexArray]:
    """Covariances (p, n, n) from resonances, and amplitudes (p, s, n) that sinusoids leave.

    ``which`` (p,) is the closed loop of each row of the vibrations.
    """
    n, count, rate = loops.hardware.modes, which.size, loops.hardware.frame_rate_hz
    stable = loops.stable[which]
    random_nm2 = np.full((count, n, n), np.nan)
    amplitudes_nm = np.full((count, sum(line.damping is None for line in lines), n), np.nan + 0j)
    random_nm2[stable], amplitudes_nm[stable] = 0.0, 0.0
    for points, subloops in loops.by_delay():
        place = np.full(loops.stable.size, -1)
        place[points] = np.arange(points.size)
        found = np.flatnonzero(stable & (place[which] >= 0))
        for start in range(0, found.size, _AT_ONCE):
            rows = found[start : start + _AT_ONCE]
            own = place[which[rows]]
            chosen = [(modes, closed.take(own)) for modes, closed in subloops]
            sinusoid = 0
            for line in lines:
                frequency, rms = line.frequency_hz[rows], line.rms_nm[rows]
                direction = line.direction[rows]
                if line.damping is None:
                    peak = direction * np.sqrt(2) * rms[:, None]
                    for modes, closed in chosen:
                        response = closed.rejections(2 * np.pi * frequency / rate)
                        left = (response @ peak[:, modes, None])[..., 0]
                        amplitudes_nm[rows[:, None], sinusoid, modes] = left
                    sinusoid += 1
                    continue
                coefficients, driving = sampled_lines(frequency, line.damping[rows], rms, rate)
                process = ModalTurbulence(
                    coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=rate
                )
                add_process(random_nm2, rows, chosen, process, direction)
    return random_nm2, amplitudes_nm
