"""Residuals that turbulence and noise leave in many loops."""

from __future__ import annotations

import numpy as np

from lbt_synth.loop.ensemble.ar_covariances import PROCESSES, add_process
from lbt_synth.loop.ensemble.closed_loops import ClosedLoops
from lbt_synth.loop.ensemble.loop_ensemble import Turbulence, turbulence_rows
from lbt_synth.loop.ensemble.spectral_covariances import spectral_covariances
from lbt_synth.validation import FloatArray


def turbulence_and_noise_covariances(
    loops: ClosedLoops,
    turbulence: list[tuple[Turbulence, tuple[int, ...]]],
    noise_nm: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Covariances (p, n, n) of the residual from turbulence, and from noise (p, q).

    ``turbulence`` pairs each spectrum with its modes. Unstable loops have nan.
    """
    rate, n = loops.hardware.frame_rate_hz, loops.hardware.modes
    turbulence_nm2, noise_nm2 = np.full((2, loops.stable.size, n, n), np.nan)
    turbulence_nm2[loops.stable], noise_nm2[loops.stable] = 0.0, 0.0
    for subloop, groups in loops.subloops:
        smooth = []
        for spectrum, modes in turbulence:
            own = [j for j, mode in enumerate(subloop.modes) if mode in modes]
            if own and not isinstance(spectrum, PROCESSES):
                smooth.append((spectrum, own))
        for group in groups:
            for batch in group.batches(loops.stable):
                rows = batch.mirrors.rows
                at = (rows[:, None, None], *np.ix_(subloop.modes, subloop.modes))
                spectra = [(turbulence_rows(spectrum, rows), own) for spectrum, own in smooth]
                turbulence_nm2[at], noise_nm2[at] = spectral_covariances(
                    subloop,
                    batch.mirrors,
                    batch.poles,
                    loops.sensor_gains[rows],
                    spectra,
                    noise_nm[rows][:, subloop.measurements],
                    rate,
                )
    for spectrum, modes in turbulence:
        if not isinstance(spectrum, PROCESSES):
            continue
        for rows, subloops in loops.by_delay():
            found = np.flatnonzero(loops.stable[rows])
            if found.size:
                chosen = [(own, closed.take(found)) for own, closed in subloops]
                process = turbulence_rows(spectrum, rows[found])
                assert isinstance(process, PROCESSES)
                for mode in modes:
                    add_process(turbulence_nm2, rows[found], chosen, process, np.eye(n)[mode])
    return turbulence_nm2, noise_nm2
