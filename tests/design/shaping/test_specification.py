"""Which demands of a shaped design other controllers violate."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.design.shaping.specification import violated_demands

AIR = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
BAND = lbt.design.shaping.VibrationBand(low_hz=18, high_hz=22, rms_nm=100)
LINES = tuple(
    lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=100, direction=d)
    for f, d in ((20, (1, 0)), (31, (0, 1)))
)


@pytest.fixture(scope="module")
def plant():
    return lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=AIR, vibrations=LINES, noise_nm=20.0, delay_frames=2
    )


@pytest.fixture(scope="module")
def design(plant):
    return lbt.robust(plant, bands=[BAND], sensor_gain=(0.5, 1.5), functions=16, states=None)


def violated(design, controller):
    return violated_demands(design.specifications, design.hardware, controller)


def test_a_design_violates_none_of_its_own_demands(design):
    assert violated(design, design.controller) == ()


def test_an_integrator_violates_what_its_margins_say(design):
    low, high = (lbt.integrator(design.hardware, gain=gain) for gain in (0.2, 0.9))
    assert violated(design, low.controller) == ()
    broken = violated(design, high.controller)
    assert lbt.loop_margins(lbt.close_loop(design.hardware, high.controller)).modulus < 0.45
    assert broken == (
        "modulus margin of at least 0.45",
        "stability for sensor gains 0.5 to 1.5 and delay errors up to 0.1 frames",
    )


def test_a_filter_with_poles_outside_the_circle_on_one_axis_is_judged_on_each(design):
    loud = [replace(line, rms_nm=800, damping=0.005) for line in LINES]
    strong = lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=AIR, vibrations=loud, noise_nm=5.0, delay_frames=2
    )
    controller = lbt.kalman(strong).controller
    assert np.max(np.abs(np.linalg.eigvals(controller.A))) > 1
    margins = lbt.loop_margins(lbt.close_loop(design.hardware, controller))
    expected = []
    if margins.modulus < 0.45:
        expected.append("modulus margin of at least 0.45")
    if margins.gain_low > 0.5 or margins.gain_high < 1.5:
        expected.append("stability for sensor gains 0.5 to 1.5 and delay errors up to 0.1 frames")
    assert list(violated(design, controller)) == expected


def test_coupled_axes_are_not_judged(design):
    across = replace(LINES[0], direction=(np.sqrt(0.5), np.sqrt(0.5)))
    coupled = lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=AIR, vibrations=[across], noise_nm=20.0, delay_frames=2
    )
    assert violated(design, lbt.kalman(coupled).controller) is None
