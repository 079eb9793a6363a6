"""Closed loops around a mirror with dynamics."""

from __future__ import annotations

import re

import numpy as np
import pytest
from support.plants import ROOT, lbt_axis_plant

import lbt_synth as lbt

QUICK = {"natural_frequency_hz": 50, "damping": 0.5, "bandwidth_hz": 500}
SLOW = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 70, "delay_samples": 2}


def shell(**changes):
    return lbt.models.PositionLoop.from_bandwidth(**{**QUICK, **changes})


@pytest.mark.parametrize("delay", [1.0, 1.4, 2.0, 2.5])
@pytest.mark.parametrize("feedthrough", [False, True])
def test_the_loop_with_a_moving_mirror_is_affine_in_the_filter(delay, feedthrough):
    rng = np.random.default_rng(3)
    influence = np.array([[1.0, 0.1], [-0.2, 0.9]])
    path = lbt.LoopHardware(
        frame_rate_hz=800, delay_frames=delay, influence_matrix=influence, mirror=shell(**SLOW)
    )
    parameter = lbt.Controller(
        A=np.diag([0.9, 0.4, -0.5]),
        B=rng.normal(size=(3, 2)),
        C=rng.normal(size=(2, 3)),
        D=rng.normal(size=(2, 2)) * feedthrough,
        dt_s=1 / 800,
    )
    loop = lbt.close_loop(path, lbt.loop.youla_controller(path, parameter))
    assert loop.is_stable
    f = np.array([0.0, 3.0, 20.0, 150.0, 400.0])
    z = np.exp(2j * np.pi * f / 800)[:, None, None]
    Q = parameter.to_statespace().frequency_response(f)
    M = sum(tap * influence * z**-i for i, tap in enumerate(path.mirror_taps))
    np.testing.assert_allclose(loop.sensitivity(f), np.eye(2) - M @ Q / z, atol=1e-10)
    np.testing.assert_allclose(loop.noise_transfer(f), -M @ Q, atol=1e-10)


def test_simulation_by_taps_is_that_of_the_states():
    plant = lbt_axis_plant(modes=1)
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, mirror=shell(**SLOW))
    slow = lbt.integrator(path, gain=0.1)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    same = {"hardware": path, "frames": 400, "seed": 3, "settle_frames": 100}
    by_states = lbt.simulate(slow.controller, truth, **same)
    by_taps = lbt.simulate(slow.controller.start(), truth, **same)
    np.testing.assert_allclose(by_states.residual_nm, by_taps.residual_nm, atol=1e-9)


def test_the_page_says_where_the_settled_design_becomes_unstable(config):
    """Stable at the figure of docs/mirror.md, unstable a tenth of a hertz below."""
    text = (ROOT / "docs" / "mirror.md").read_text(encoding="utf-8")
    edge = float(re.search(r"stable down to ([\d.]+) Hz", text)[1])
    settled = lbt.kalman(config.plant)
    for bandwidth, stable in ((edge, True), (edge - 0.1, False)):
        mirror = shell(natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth)
        path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, mirror=mirror)
        assert lbt.close_loop(path, settled.controller).is_stable is stable
