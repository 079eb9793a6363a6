"""What turbulence and noise leave in many loops."""

from __future__ import annotations

import numpy as np

from lbt_synth.loop.ensemble.ar_covariances import PROCESSES, add_process
from lbt_synth.loop.ensemble.closed_loops import ClosedLoops
from lbt_synth.loop.ensemble.loop_ensemble import Turbulence, turbulence_rows
from lbt_synth.loop.ensemble.spectral_covariances import sample_responses, spectral_covariances
from lbt_synth.validation import FloatArray


def turbulence_and_noise_covariances(
    loops: ClosedLoops,
    turbulence: list[tuple[Turbulence, tuple[int, ...]]],
    noise_nm: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Covariances of the residual from turbulence and from noise.

    Shapes: turbulence list of (Turbulence, tuple of int), noise_nm (p, q) -> turbulence_nm2,
    noise_nm2 (p, n, n).
    """
    rate, n = loops.hardware.frame_rate_hz, loops.modes
    turbulence_nm2, noise_nm2 = np.full((2, loops.stable.size, n, n), np.nan)
    turbulence_nm2[loops.stable], noise_nm2[loops.stable] = 0.0, 0.0
    for part, groups in loops.pieces:
        smooth = []
        for spectrum, modes in turbulence:
            own = [j for j, mode in enumerate(part.modes) if mode in modes]
            if own and not isinstance(spectrum, PROCESSES):
                smooth.append((spectrum, own))
        for group in groups:
            for batch in group.batches(loops.stable):
                rows = batch.mirrors.rows
                at = (rows[:, None, None], *np.ix_(part.modes, part.modes))
                spectra = [(turbulence_rows(spectrum, rows), own) for spectrum, own in smooth]
                sweep = sample_responses(
                    part, batch.mirrors, batch.poles, [s for s, _ in spectra], rate
                )
                turbulence_nm2[at], noise_nm2[at] = spectral_covariances(
                    part,
                    batch.mirrors,
                    loops.sensor_gains[rows],
                    sweep,
                    spectra,
                    noise_nm[rows][:, part.measurements],
                    rate,
                )
    for spectrum, modes in turbulence:
        if isinstance(spectrum, PROCESSES):
            for rows, stacks in loops.by_delay():
                found = np.flatnonzero(loops.stable[rows])
                if not found.size:
                    continue
                chosen = [(own, stack.take(found)) for own, stack in stacks]
                process = turbulence_rows(spectrum, rows[found])
                assert isinstance(process, PROCESSES)  # rows of one are one
                for mode in modes:
                    add_process(turbulence_nm2, rows[found], chosen, process, np.eye(n)[mode])
    return turbulence_nm2, noise_nm2
