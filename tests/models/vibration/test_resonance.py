"""Vibrations as AR2 processes: their rms, damping and direction."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import lbt_synth as lbt


def test_vibration_of_the_lbt():
    model = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=1.0).ar_model(800)
    assert model.coefficients == pytest.approx([1.972279, -0.996863], abs=5e-7)
    assert model.driving_rms_nm == pytest.approx(0.012381, abs=5e-7)


@given(frequency=st.floats(1, 399), damping=st.floats(1e-4, 0.9), rms=st.floats(1e-3, 1e6))
def test_vibration_keeps_its_rms(frequency, damping, rms):
    model = lbt.Vibration(frequency_hz=frequency, damping=damping, rms_nm=rms).ar_model(800)
    assert model.rms_nm == pytest.approx(rms, rel=1e-7)


def test_retuned_vibration_holds_what_it_is_told():
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100)
    driving = line.ar_model(800).driving_rms_nm
    held = line.retuned(17, frame_rate_hz=800, hold="driving")
    assert held.ar_model(800).driving_rms_nm == pytest.approx(driving, rel=1e-12)
    assert line.retuned(17, frame_rate_hz=800).rms_nm == 100


def test_direction_becomes_a_unit_vector():
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=1, direction=(3, 4))
    assert line.direction == pytest.approx((0.6, 0.8))


@pytest.mark.parametrize("damping", [0.0, 1.0, 1.5])
def test_damping_lies_in_the_open_interval(damping):
    with pytest.raises(lbt.errors.ProblemError, match="damping must be"):
        lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=1)


def test_a_vibration_above_nyquist_is_refused():
    with pytest.raises(
        lbt.errors.ProblemError, match="below the Nyquist frequency 400 Hz; got 500 Hz"
    ):
        lbt.Vibration(frequency_hz=500, damping=0.1, rms_nm=1).ar_model(800)
