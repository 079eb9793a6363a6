"""Loops stepped on series that are given."""

import numpy as np

import lbt_synth as lbt


def recorded_run(controller, hardware, total, noise, *, sensor_gain=1.0, stroke=None):
    """Residual, commands and measurements side by side, (cases, frames, n + m + q)."""
    series = lbt.loop.Disturbance(
        phase_nm=total, noise=noise, sensor_gain=sensor_gain, frame_means=True
    )
    run = lbt.simulate(controller, series, hardware=hardware, stroke=stroke)
    return np.concatenate([run.residual_nm, run.commands, run.measurements], axis=2)
