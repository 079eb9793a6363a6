"""Lines next to each other: ``python benchmarks/tracking_neighbours.py``."""

import time
from dataclasses import replace

import numpy as np

import lbt_synth as lbt

RATE, FRAMES, CASES, OFF_HZ = 800, 3200, 30, 0.8
AIR = lbt.models.ARModel(coefficients=[1.9975, -0.9976], driving_rms_nm=0.6, frame_rate_hz=RATE)


def line(frequency_hz, damping, rms_nm):
    return lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=rms_nm, direction=(1,))


for lines in (
    (line(20, 0.01, 300), line(23, 0.01, 300)),
    (line(20, 0.03, 200), line(22, 0.03, 200)),
    (line(18, 0.01, 200), line(21, 0.01, 200), line(24, 0.01, 200)),
):
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=AIR, vibrations=lines, noise_nm=15.5, modes=1
    )
    true = tuple(replace(one, frequency_hz=one.frequency_hz + OFF_HZ) for one in lines)
    idle = lbt.Controller(A=0.0, B=0.0, C=0.0, D=0.0, dt_s=1 / RATE)
    truth = lbt.Truth(turbulence=AIR, vibrations=true, noise_nm=15.5)
    windows = lbt.simulate(
        idle, truth, hardware=plant.hardware, frames=FRAMES, cases=CASES
    ).measurements
    follow, errors, begin = lbt.identification.LineFollower(plant), [], time.process_time()
    for window in windows:
        follow.reset()
        found = follow(window, np.zeros_like(window))
        if found is not None:
            errors.append(
                [
                    a.frequency_hz - b.frequency_hz
                    for a, b in zip(found.vibrations, true, strict=True)
                ]
            )
    took_ms = 1e3 * (time.process_time() - begin) / CASES
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    print(
        f"{[one.frequency_hz for one in true]} Hz, damping {lines[0].damping}: found in "
        f"{len(errors)} of {CASES} windows, off by {np.round(rms, 2)} Hz rms, {took_ms:.0f} ms"
    )
