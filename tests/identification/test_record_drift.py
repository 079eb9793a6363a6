"""Offset and drift of a record, and what a filter leaves of them."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.identification.record_drift import note_drift

RATE = 500.0
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=RATE)


def drifting_record(offset_nm: float, speed_nm_s: float) -> lbt.identification.LoopRecord:
    """A record of noise whose commands move, on the second axis; its sensor gain is 0.5."""
    noise = np.random.default_rng(0).standard_normal((5000, 2))
    commands = np.zeros((5000, 2))
    commands[:, 1] = offset_nm + speed_nm_s * (np.arange(5000) - 2500) / RATE
    return lbt.identification.loop_record(
        noise, commands, frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )


def test_what_a_filter_leaves_of_a_drift_is_noted():
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=SLOW, noise_nm=5.0, sensor_gain=0.5)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    left = abs(loop.sensitivity([1e-6])[0, 1, 1])
    assert 0.01 < left < 0.5
    residual = np.array([10.0, 10.0])
    assert list(note_drift(drifting_record(10.0, 1.0), loop, residual)) == []
    (note,) = note_drift(drifting_record(3000.0, -200.0), loop, residual)
    assert note.startswith("axis 1 of the record stands 3e+03 nm off zero and drifts by -200 nm/s.")
    said = float(note.split("leaves up to ")[1].split(" nm")[0])
    assert said == pytest.approx(left * (3000 + 5 * 200), rel=0.05)
