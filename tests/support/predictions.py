"""Loops and records that the tests of predictions share."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.identification.prediction import residual

RATE = 800
CAMERA = lbt.Imaging(diameter_m=8.22)
SLOW = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=RATE)
SHELL = lbt.models.PositionLoop.from_bandwidth(
    natural_frequency_hz=20, damping=0.5, bandwidth_hz=300
)
LINES = (
    lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=(1, 0)),
    lbt.Vibration(frequency_hz=33, damping=0.02, rms_nm=100, direction=(0, 1)),
)


def a_plant(*, delay=2.0, gain=1.0, mirror=None, sensor=None):
    models = {"turbulence": SLOW, "vibrations": LINES, "noise_nm": 15.5, "mirror": mirror}
    path = {"delay_frames": delay, "sensor_gain": gain, "sensor_matrix": sensor}
    return lbt.tip_tilt_plant(frame_rate_hz=RATE, **models, **path)


def a_truth(gain=1.0, noise_nm=15.5):
    return lbt.Truth(turbulence=SLOW, vibrations=LINES, noise_nm=noise_nm, sensor_gain=gain)


def truth_of_all_moments(**facts):
    """Return the truth whose lines have, as means over frames, the rms of the plant's."""
    truth = a_truth(**facts)
    lines = [
        replace(line, rms_nm=line.rms_nm / np.sinc(line.frequency_hz / RATE))
        for line in truth.vibrations
    ]
    return replace(truth, vibrations=lines)


def pseudo_open_loop(y, u, hardware, gain=1.0):
    """Textbook: z(k) = y(k) / g + c[0] u(k-1) + c[1] u(k-2) + ..., from a loop at rest."""
    z = y @ np.linalg.inv(gain * hardware.sensor).T
    for i, tap in enumerate(hardware.mirror_taps):
        z[1 + i :] += tap * u[: len(u) - 1 - i] @ hardware.influence.T
    return z


def replayed_residual(
    z, controller, hardware, *, noise_nm, noise_error_nm=0.0, stretches=None, test=None
):
    """Return what a controller would have left of a series on the frames of a test."""
    runs = tuple(stretches or ((0, len(z)),))
    kept = residual.settled_test(runs, runs if test is None else tuple(test), hardware)
    noise_nm2 = np.square(noise_nm) * np.eye(hardware.n_measurements)
    measured = residual.gather(residual.replay(lbt.close_loop(hardware, controller), z, runs), kept)
    return residual.estimate_residual(
        measured, kept, *residual.mode_noise(hardware, noise_nm2, noise_error_nm)
    )


def record_of(z, hardware, *, measured=None):
    """Return the record of an open loop whose pseudo-open-loop series is z."""
    every = np.ones(len(z), bool)
    return lbt.identification.LoopRecord(
        frame_rate_hz=hardware.frame_rate_hz,
        measurements=z @ hardware.sensor.T,
        measured=every if measured is None else measured,
        commanded=every,
    )


def a_series(model, frames, rng, more=4000):
    white = rng.standard_normal(frames + more)
    return lfilter([model.driving_rms_nm], np.r_[1, -model.coefficients], white)[more:]


TILTED = np.array([[1.0, 0.3], [-0.2, 0.8]])
CASES = [
    pytest.param(2.0, 1.0, None, None, id="delay 2"),
    pytest.param(1.0, 0.6, None, None, id="delay 1"),
    pytest.param(2.4, 0.5, None, None, id="fraction"),
    pytest.param(3.0, 1.3, None, None, id="delay 3"),
    pytest.param(2.0, 0.6, SHELL, None, id="moving mirror"),
    pytest.param(2.25, 0.8, SHELL, TILTED, id="moving mirror, fraction, crossed sensor"),
]
GOOD = np.random.default_rng(0).standard_normal((2000, 2))
PATH = lbt.LoopHardware(frame_rate_hz=RATE)
