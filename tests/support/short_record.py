"""A short record of one axis."""

from __future__ import annotations

from functools import cache

import lbt_synth as lbt

RATE, NOISE, GAIN = 500.0, 5.0, 0.8
PATH = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=RATE)
LINE = lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=60, direction=(1.0,))
TRUTH = lbt.Truth(turbulence=SLOW, vibrations=(LINE,), noise_nm=NOISE, sensor_gain=GAIN)


@cache
def short_record() -> lbt.identification.LoopRecord:
    """One axis for 18 s, in the loop of an integrator."""
    ran = lbt.integrator(PATH, gain=0.3).controller
    run = lbt.simulate(ran, TRUTH, hardware=PATH, frames=9000)
    return lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
