"""A night on which an integrator ran two axes, with a vibration on the first of them."""

from functools import cache

from support.recorded_loops import RATE, record_of, slow

import lbt_synth as lbt

LINE_HZ, LINE_NM, NOISE, GAIN = 31.0, 60.0, 8.0, 0.7


@cache
def simulated_night():
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    line = lbt.Vibration(frequency_hz=LINE_HZ, damping=0.005, rms_nm=LINE_NM, direction=(1.0, 0.0))
    truth = lbt.Truth(turbulence=slow(), vibrations=(line,), noise_nm=NOISE, sensor_gain=GAIN)
    ran = lbt.integrator(path, gain=0.4)
    return lbt.simulate(ran.controller, truth, hardware=path, frames=12_000, seed=1), path, ran


def night_record():
    """The record of the simulated night, as telemetry would hold it."""
    run, path, _ = simulated_night()
    return record_of(run, path)
