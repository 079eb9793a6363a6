"""Plants, disturbances and runs that the tests of tracking share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lbt_synth as lbt
from lbt_synth.loop.simulation.disturbances import draw_disturbance, draw_noise
from lbt_synth.loop.simulation.run import step_loop
from lbt_synth.models.plant.tip_tilt import with_vibrations

AIR = lbt.models.ARModel(coefficients=[1.9975, -0.9976], driving_rms_nm=0.6, frame_rate_hz=800)


def line(frequency_hz, damping=0.02):
    return lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=300, direction=(1,))


def axis(*frequencies_hz, noise_nm=15.5, **changes):
    settings = {"frame_rate_hz": 800, "turbulence": AIR, "noise_nm": noise_nm, "modes": 1}
    return lbt.tip_tilt_plant(
        **(settings | changes), vibrations=[line(f) for f in frequencies_hz] or None
    )


def disturbed(plant, *, frames, hz=20, seed=0, damping=None):
    """Total phase and noise, (1, frames, n) each."""
    shake = (
        lbt.models.SinusoidalVibration(frequency_hz=hz, rms_nm=300, direction=(1,))
        if damping is None
        else line(hz, damping)
    )
    truth = lbt.Truth(turbulence=AIR, vibrations=(shake,), noise_nm=15.5)
    rng = np.random.default_rng(seed)
    size = {"frames": frames, "cases": 1, "rng": rng}
    return draw_disturbance(truth, plant.hardware, **size), draw_noise(
        truth, plant.hardware, **size
    )


def run(controller, plant, series, gain=1.0):
    return step_loop(controller, gain, plant.hardware, *series)[0]


def sensed(plant):
    """The plant with two axes, coupled sensor and mirror, and a sensor gain."""
    return lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=AIR,
        noise_nm=15.5,
        delay_frames=2.4,
        vibrations=[replace(line(21), direction=(1, 0.5))],
        sensor_gain=0.8,
        sensor_matrix=[[1, 0.1], [0.2, 0.9], [0.3, -0.4]],
        influence_matrix=[[1, 0.2], [0, 0.9]],
    )


# The tracker.
class Oracle:
    """Knows the frequency of each window."""

    def __init__(self, plant, frequency_hz_at, first_s, every_s):
        self.plant, self.at = plant, frequency_hz_at
        self.first_s, self.every_s = first_s, every_s
        self.reset()

    def reset(self):
        self.calls = 0

    def __call__(self, measurements, corrections):
        middle_s = self.first_s + self.calls * self.every_s - len(measurements) / 1600
        self.calls += 1
        frequency_hz = float(self.at(middle_s))
        return with_vibrations(self.plant, [self.plant.vibrations[0].at_frequency(frequency_hz)])


DRIFT = lbt.models.DriftingVibration(
    start_hz=18, end_hz=22, duration_s=8, rms_nm=300, direction=(1,)
)


SHAKEN = lbt.Truth(turbulence=AIR, vibrations=(DRIFT,), noise_nm=15.5)


def simulated(controller, truth=SHAKEN, frames=7200):
    return lbt.simulate(
        controller, truth, hardware=axis(18).hardware, frames=frames, settle_frames=1600, seed=2
    )


def broken(_measurements, _corrections):
    raise np.linalg.LinAlgError("no inverse today")
