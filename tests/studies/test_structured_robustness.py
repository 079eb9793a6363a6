"""Errors of gain, delay and mirror at the same time, against loops that have them."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.studies.structured_robustness import _POLE, _SLOPE, uncertain_loop

PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)
LAZY = lbt.integrator(PATH, gain=0.5).controller
LOOP = lbt.close_loop(PATH, LAZY)


def test_the_weight_covers_every_delay_up_to_its_own():
    theta = np.linspace(1e-6, np.pi, 2001)
    z = np.exp(1j * theta)
    weight = np.abs(_SLOPE * (z - 1) / (z - _POLE))
    assert np.all(weight >= theta * (1 - 1e-9))
    assert np.max(weight / theta) < 1.12
    for tau in (0.1, 0.5, 1.0):
        assert np.all(np.abs(z**-tau - 1) <= tau * weight)


def test_gain_alone_is_the_gain_margin():
    found = lbt.studies.structured_robustness(LOOP, gain=0.5, delay_frames=0, mirror=0)
    assert found.proved == pytest.approx(2, rel=3e-3)


def test_mirror_alone_is_the_norm_of_the_complementary_sensitivity():
    found = lbt.studies.structured_robustness(LOOP, gain=0, delay_frames=0, mirror=0.1)
    S = LOOP.output_sensitivity()
    T = lbt.linear.StateSpace(A=S.A, B=S.B, C=-S.C, D=np.eye(1) - S.D)
    assert found.proved == pytest.approx(10 / float(lbt.hinf_norm(T)), rel=3e-3)
    assert found.unstable == pytest.approx(found.proved, rel=1e-2)


def test_loops_inside_the_proved_box_are_stable():
    found = lbt.studies.structured_robustness(LOOP, gain=0.3, delay_frames=0.15, mirror=0)
    assert found.proved > 1
    for late in (-0.15, 0.0, 0.15):
        later = lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=2 + late)
        for gain in (0.7, 1.3):
            assert lbt.close_loop(later, LAZY, sensor_gain=gain).is_stable


def test_the_system_is_the_chain_written_out():
    system = uncertain_loop(LOOP.output_sensitivity(), 0.3, 0.2, 0.1)
    f = np.array([37.0])
    z = np.exp(2j * np.pi * f[0] / 800)
    chain = 0.5 / (z**2 - z)  # g z^-2 / (1 - z^-1)
    T = chain / (1 + chain)
    late = 0.2 * _SLOPE * (z - 1) / (z - _POLE)
    rows = np.array([0.1, late, 0.3])[:, None]
    expected = rows * (np.tri(3, k=-1) - T)
    np.testing.assert_allclose(system.frequency_response(f)[0], expected, atol=1e-12)


def test_no_error_at_all_is_refused():
    with pytest.raises(lbt.errors.ProblemError, match="above 0"):
        lbt.studies.structured_robustness(LOOP, gain=0, delay_frames=0, mirror=0)


@pytest.mark.parametrize("name", ["gain", "delay_frames", "mirror"])
def test_an_absurd_error_is_refused(name):
    sizes = {"gain": 0.3, "delay_frames": 0.2, "mirror": 0.1, name: 1e300}
    with pytest.raises(lbt.errors.ProblemError, match=f"{name} must be at most 1000"):
        lbt.studies.structured_robustness(LOOP, **sizes)
    found = lbt.studies.structured_robustness(LOOP, **sizes | {name: 1000})
    assert 0 < found.proved < 0.01
