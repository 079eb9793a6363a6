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


@pytest.mark.parametrize(
    ("delay", "feedthrough", "moving"),
    [
        (1.0, True, None),
        (1.3, False, None),
        (4.0, True, None),
        (1.0, False, SHELL),
        (1.4, True, SHELL),
        (2.5, False, SHELL),
    ],
)
def test_the_closed_loop_is_affine_in_the_filter(delay, feedthrough, moving):
    rng = np.random.default_rng(3)
    A = np.diag([0.9, 0.4, -0.5])
    sensor = np.array([[1.0, 0.2], [0.0, 0.8], [0.1, 0.1]])
    mirror = np.array([[1.0, 0.1], [-0.2, 0.9]])
    path = lbt.LoopHardware(
        frame_rate_hz=800,
        delay_frames=delay,
        sensor_matrix=sensor,
        influence_matrix=mirror,
        mirror=moving,
    )
    parameter = lbt.Controller(
        A=A,
        B=rng.normal(size=(3, 3)),
        C=rng.normal(size=(2, 3)),
        D=rng.normal(size=(2, 3)) if feedthrough else np.zeros((2, 3)),
        dt_s=1 / 800,
    )
    loop = lbt.close_loop(path, youla_controller(path, parameter))
    assert loop.is_stable
    f = np.array([0.0, 3.0, 20.0, 150.0, 400.0])
    z = np.exp(2j * np.pi * f / 800)[:, None, None]
    Q = parameter.to_statespace().frequency_response(f)
    M = sum(tap * mirror * z**-i for i, tap in enumerate(path.mirror_taps))
    np.testing.assert_allclose(loop.sensitivity(f), np.eye(2) - M @ Q @ sensor / z, atol=1e-10)
    np.testing.assert_allclose(
        loop.path("noise", "residual").frequency_response(f), -M @ Q, atol=1e-10
    )


def test_a_filter_of_another_size_is_refused():
    path = lbt.LoopHardware(frame_rate_hz=800)
    with pytest.raises(
        lbt.errors.DimensionError, match="map 2 measurements to 2 commands; got 1 to 1"
    ):
        youla_controller(path, lbt.Controller(A=0.0, B=1.0, C=1.0, D=0.0, dt_s=1 / 800))
