"""One closed loop against transfer functions."""

from __future__ import annotations

import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.lqg import shell
from support.plants import ROOT, lbt_axis_plant

import lbt_synth as lbt


@given(gain=st.floats(0.2, 1.5))
def test_error_transfer_of_the_lbt(gain):
    """Error ``E = (1-h)/(1-(1-g) h)``, noise ``-z^-1 H/(1-(1-g) h)``, h = z^-2 H."""
    plant = lbt_axis_plant()
    design = lbt.kalman(plant)
    loop = lbt.close_loop(plant.hardware, design.controller, sensor_gain=gain)
    f = np.geomspace(0.1, 399, 60)
    z = np.exp(2j * np.pi * f / 800)
    closed = plant.A - design.gain_predictor @ plant.C
    H = np.array(
        [
            v * (plant.L @ np.linalg.solve(v * np.eye(4) - closed, design.gain_predictor))[0, 0]
            for v in z
        ]
    )
    h = H / z**2
    assert np.allclose(loop.sensitivity(f)[:, 0, 0], (1 - h) / (1 - (1 - gain) * h), rtol=1e-8)
    noise = -(H / z) / (1 - (1 - gain) * h)
    assert np.allclose(loop.noise_transfer(f)[:, 0, 0], noise, rtol=1e-8)


@given(gain=st.floats(0.01, 0.99), delay=st.integers(1, 4))
def test_integrator_loop_is_its_textbook_transfer_function(gain, delay):
    g = gain * lbt.design.integrator_gain_limit(delay)
    path = lbt.LoopHardware(frame_rate_hz=500, delay_frames=delay, modes=1)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=g).controller)
    z = np.exp(2j * np.pi * np.array([1.0, 40, 200]) / 500)
    open_loop = g * z**-delay / (1 - 1 / z)
    assert np.allclose(loop.sensitivity([1.0, 40, 200])[:, 0, 0], 1 / (1 + open_loop), rtol=1e-9)


def test_the_page_says_where_the_settled_design_becomes_unstable(config):
    """Stable at the figure of docs/mirror.md, unstable a tenth of a hertz below."""
    text = (ROOT / "docs" / "mirror.md").read_text(encoding="utf-8")
    edge = float(re.search(r"stable down to ([\d.]+) Hz", text)[1])
    settled = lbt.kalman(config.plant)
    for bandwidth, stable in ((edge, True), (edge - 0.1, False)):
        mirror = shell(natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth)
        path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, mirror=mirror)
        assert lbt.close_loop(path, settled.controller).is_stable is stable
