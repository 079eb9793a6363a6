"""A short record, its splits and a league of it."""

from __future__ import annotations

from functools import cache

import lbt_synth as lbt
from lbt_synth.identification.prediction.forward_chaining import forward_split

RATE, NOISE, GAIN = 500.0, 5.0, 0.8
PATH = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=RATE)
LINE = lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=60, direction=(1.0,))
TRUTH = lbt.Truth(turbulence=SLOW, vibrations=(LINE,), noise_nm=NOISE, sensor_gain=GAIN)
QUICK = ("ran", "best-integrator", "least-squares-32", "kalman")


@cache
def short_record(seed: int = 0, *, closed: bool = True) -> lbt.identification.LoopRecord:
    """One axis for 18 s, in the loop of an integrator or as an open loop."""
    ran = lbt.integrator(PATH, gain=0.3).controller
    run = lbt.simulate(ran, TRUTH, hardware=PATH, frames=9000, seed=seed)
    series = (run.measurements[0], run.commands[0]) if closed else (run.total_nm[0],)
    return lbt.identification.loop_record(
        *series, frame_rate_hz=RATE, delay_frames=2 if closed else None, unit="nm"
    )


@cache
def short_split() -> lbt.identification.ForwardSplit:
    """The first of its two splits, at the true sensor gain."""
    record = short_record()
    pairs = lbt.identification.forward_splits(record.stretches(), record.frames, splits=2)
    return forward_split(record, *pairs[0], sensor_gain=GAIN, most_lines=2)
