"""One closed loop against transfer functions."""

import re

import numpy as np
import pytest
from support.lqg import shell
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.loop.closed_loop import youla_controller

SHELL = shell(70, delay_samples=2)


def test_the_page_says_where_the_settled_design_becomes_unstable(config):
    """Stable at the figure of docs/mirror.md, unstable a tenth of a hertz below."""
    text = (ROOT / "docs" / "mirror.md").read_text(encoding="utf-8")
    edge = float(re.search(r"stable down to ([\d.]+) Hz", text)[1])
    settled = lbt.kalman(config.plant)
    for bandwidth, stable in ((edge, True), (edge - 0.1, False)):
        mirror = shell(natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth)
        path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, mirror=mirror)
        assert lbt.close_loop(path, settled.controller).is_stable is stable


@pytest.mark.parametrize("moving", [None, SHELL])
@pytest.mark.parametrize(("delay", "direct"), [(1.0, False), (1.0, True), (1.4, True), (4.0, True)])
def test_the_closed_loop_is_affine_in_the_filter(delay, direct, moving):
    rng = np.random.default_rng(3)
    sensor = np.array([[1.0, 0.2], [0.0, 0.8], [0.1, 0.1]])
    mirror = np.array([[1.0, 0.1], [-0.2, 0.9]])
    matrices = {"sensor_matrix": sensor, "influence_matrix": mirror, "mirror": moving}
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, **matrices)
    B, C, D = (rng.normal(size=size) for size in ((3, 3), (2, 3), (2, 3)))
    parts = {"A": np.diag([0.9, 0.4, -0.5]), "B": B, "C": C, "D": D * direct}
    parameter = lbt.Controller(**parts, dt_s=1 / 800)
    loop = lbt.close_loop(path, youla_controller(path, parameter))
    assert loop.is_stable
    f = np.array([0.0, 3.0, 20.0, 150.0, 400.0])
    z = np.exp(2j * np.pi * f / 800)[:, None, None]
    Q = parameter.to_statespace().frequency_response(f)
    M = sum(tap * mirror * z**-i for i, tap in enumerate(path.mirror_taps))
    np.testing.assert_allclose(loop.sensitivity(f), np.eye(2) - M @ Q @ sensor / z, atol=1e-10)
    noise = loop.path("noise", "residual").frequency_response(f)
    np.testing.assert_allclose(noise, -M @ Q, atol=1e-10)
