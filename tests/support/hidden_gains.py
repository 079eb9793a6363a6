"""Loops whose strong lines hide the sensor gain from a coarse spectrum."""

from __future__ import annotations

from functools import cache

import numpy as np

import lbt_synth as lbt

RATE = 1000
# coefficients and drive of the turbulence [nm]; lines (Hz, damping, nm, direction); noise [nm],
# sensor gain, integrator gain
_LOOPS = {
    46: (
        [1.99939396, -0.999395551],
        0.019264654,
        [
            (54.644241, 0.0057555, 99.197964, 2.62514),
            (85.627632, 0.00237002, 97.318496, 2.59532),
            (138.10218, 0.00760899, 67.016067, 2.13911),
            (14.338187, 0.00696344, 62.747013, 0.691667),
            (46.265706, 0.00300496, 94.616029, 2.62616),
        ],
        2.406247,
        0.4560861,
        0.20877578,
    ),
    92: (
        [1.99129794, -0.99132268],
        0.40117194,
        [
            (85.426096, 0.00512946, 56.493765, 2.72765),
            (121.7014, 0.00509154, 58.279039, 0.352586),
            (122.0306, 0.00410202, 23.611942, 3.07193),
            (113.77249, 0.00672471, 33.835397, 2.3283),
            (24.777701, 0.00274722, 78.039304, 0.610053),
        ],
        5.276812,
        0.6162827,
        0.2652445,
    ),
    198: (
        [1.99180077, -0.991819641],
        0.33053314,
        [
            (59.77816, 0.00922046, 26.618522, 3.03506),
            (147.00317, 0.00861081, 59.089946, 1.09802),
            (45.176974, 0.00286793, 79.169178, 1.63632),
            (113.71687, 0.00354196, 80.716156, 1.005),
            (88.666623, 0.00215286, 97.423308, 0.092637),
        ],
        4.082686,
        0.8558551,
        0.40405704,
    ),
}


@cache
def hidden_gain_loop(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Measurements and commands of 30 s."""
    coefficients, drive, lines, noise_nm, sensor_gain, gain = _LOOPS[seed]
    turbulence = lbt.models.ARModel(
        coefficients=coefficients, driving_rms_nm=drive, frame_rate_hz=RATE
    )
    truth = lbt.Truth(
        turbulence=turbulence,
        vibrations=[
            lbt.Vibration(
                frequency_hz=f, damping=damping, rms_nm=rms, direction=(np.cos(a), np.sin(a))
            )
            for f, damping, rms, a in lines
        ],
        noise_nm=noise_nm,
        sensor_gain=sensor_gain,
    )
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    law = lbt.integrator(path, gain=gain).controller
    run = lbt.simulate(law, truth, hardware=path, frames=31_000, seed=seed, frame_means=True)
    return run.measurements[0, 1000:], run.commands[0, 1000:]
