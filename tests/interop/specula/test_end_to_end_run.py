"""Optical gain, Strehl ratio and errors of an end-to-end run."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.end_to_end import CONFIG, make_run

import lbt_synth as lbt


def test_the_optical_gain_is_found_within_its_error(setup):
    system = replace(setup.system, modes=60)
    run = make_run(system)
    apart = (run.optical_gain - 0.5) / run.optical_gain_error
    assert 0.7 < np.std(apart) < 1.3
    assert abs(run.tip_tilt_gain - 0.5) < 4 * run.tip_tilt_gain_error
    assert run.tip_tilt_noise_nm == pytest.approx(10, rel=0.05)
    assert run.rms_nm == pytest.approx(np.full(60, 50), rel=0.05)


def test_the_strehl_ratio_and_its_error(setup):
    run = make_run(replace(setup.system, modes=3), frames=8000)
    assert run.strehl == pytest.approx(0.8, abs=1e-3)
    assert run.strehl_error == pytest.approx(0.01 / np.sqrt(8000), rel=0.6)
    assert run.other_modes_strehl == pytest.approx(0.85)
    short = make_run(replace(setup.system, modes=3), frames=10)
    assert np.isnan(short.strehl_error)


@settings(max_examples=25, deadline=None)
@given(gain=st.floats(0.1, 1.2), noise=st.floats(0.0, 60.0))
def test_the_gain_of_tip_and_tilt_lies_between_theirs(gain, noise):
    system = replace(lbt.load_config(CONFIG).end_to_end.system, modes=3)
    run = make_run(system, gain=gain, noise_nm=noise, frames=300)
    low, high = sorted(run.optical_gain[:2])
    assert low - 1e-12 <= run.tip_tilt_gain <= high + 1e-12
