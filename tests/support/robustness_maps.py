"""Single points of a robustness map."""

from dataclasses import replace

import lbt_synth as lbt
from lbt_synth.loop import residual_budget


def evaluate_point(design, truth, imaging, error_hz, gain, delay_error=0.0):
    """Strehl ratio and residual [nm] of one point, by the evaluator of single loops."""
    highest_hz = max((v.frequency_hz for v in truth.vibrations), default=1.0)
    lines = [
        replace(v, frequency_hz=v.frequency_hz * (1 + error_hz / highest_hz))
        for v in truth.vibrations
    ]
    met = replace(truth, sensor_gain=gain, vibrations=tuple(lines))
    path = design.hardware
    path = replace(path, delay_frames=path.delay_frames + delay_error)
    budget = residual_budget(lbt.close_loop(path, design.controller, sensor_gain=gain), met)
    return lbt.strehl(budget, imaging), budget.rms_nm
