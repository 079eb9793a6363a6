"""Drifting vibrations as a simulation draws them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import hilbert
from support.drifting import drifting
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.loop.simulation.disturbances import draw_disturbance

PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)


def drawn(line, *, frames, cases=1, zero_frame=0, seed=0):
    truth = lbt.Truth(turbulence=None, vibrations=(line,))
    rng = np.random.default_rng(seed)
    return draw_disturbance(
        truth, PATH, frames=frames, cases=cases, rng=rng, zero_frame=zero_frame
    )[..., 0]


def test_the_drawn_resonance_has_its_rms_and_its_decay():
    line = drifting(duration_s=2, damping=0.02)
    series = drawn(line, frames=2800, cases=2000, zero_frame=400)
    for frame in (0, 1, 399, 1200, 2000, 2799):
        assert series[:, frame].std() == pytest.approx(100, rel=0.07)
    early, late = series[:, :2], series[:, 2400:2402]  # before the drift, and after it
    for pair, hz in ((early, 17), (late, 23)):
        model = (
            lbt.Vibration(frequency_hz=17, damping=0.02, rms_nm=100).at_frequency(hz).ar_model(800)
        )
        a1, a2 = model.coefficients
        correlation = np.mean(pair[:, 0] * pair[:, 1]) / np.mean(pair**2)
        assert correlation == pytest.approx(a1 / (1 - a2), abs=1.5e-3)


def test_time_0_is_the_first_kept_frame():
    plant = lbt_axis_plant()
    truth = lbt.Truth(turbulence=None, vibrations=(drifting(),), noise_nm=1)
    gentle = lbt.integrator(plant.hardware, gain=0.3).controller
    series = {
        settle: lbt.simulate(
            gentle, truth, hardware=plant.hardware, frames=4000, settle_frames=settle
        ).total_nm[0, :, 0]
        for settle in (0, 1000)
    }
    # the same phase at random but for the settling: the same frequencies in the same frames
    phases = [np.unwrap(np.angle(hilbert(s))) for s in series.values()]
    apart = np.diff(phases, axis=0)[0][300:-300]
    assert np.ptp(apart) < 0.05
