"""Loops of two axes whose control law is known, for the tests of commands."""

from functools import cache

import numpy as np
from support.recorded_loops import RATE, slow

import lbt_synth as lbt

PATH = lbt.LoopHardware(frame_rate_hz=RATE)
LINE = lbt.Vibration(frequency_hz=31, damping=0.005, rms_nm=60, direction=(1.0, 0.5))
TRUTH = lbt.Truth(turbulence=slow(), vibrations=(LINE,), noise_nm=8.0, sensor_gain=0.7)


class SteppedLaw:
    """``v(k) = leak v(k-1) + gain y(k)`` of two axes, integrated again, clipped and disturbed."""

    def __init__(
        self, gain, *, leak=1.0, again=None, limit_nm=np.inf, wind_up=False, dither_nm=0.0
    ):
        self.gain = np.asarray(gain) if np.ndim(gain) else gain * np.eye(2)
        self.leak, self.again = leak, again
        self.limit_nm, self.wind_up, self.dither_nm = limit_nm, wind_up, dither_nm
        self.reset()

    def reset(self):
        self.command, self.sum = np.zeros(2), np.zeros(2)
        self.random = np.random.default_rng(5)

    def step(self, y):
        move = self.gain @ y + self.dither_nm * self.random.standard_normal(2)
        if self.again is not None:
            self.sum = self.sum + self.again * move
            move = move + self.sum
        command = self.leak * self.command + move
        applied = np.clip(command, -self.limit_nm, self.limit_nm)
        self.command = command if self.wind_up else applied
        return applied.copy()


def run_law(controller, *, frames=3000, seed=1, truth=TRUTH, hardware=PATH):
    """Measurements and commands of a loop, (frames, 2) each."""
    options = {"frames": frames, "seed": seed, "frame_means": True}
    run = lbt.simulate(controller, truth, hardware=hardware, **options)
    return run.measurements[0], run.commands[0]


@cache
def ordinary_loop(seed=1):
    """Measurements and commands of an integrator with gains of 0.4 and 0.3."""
    law = lbt.Controller(
        A=np.eye(2), B=np.diag([0.4, 0.3]), C=np.eye(2), D=np.zeros((2, 2)), dt_s=1 / RATE
    )
    return run_law(law, seed=seed, frames=10_000)


def rotation(angle_deg):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, -s], [s, c]])
