"""Which demands of a shaped design other controllers violate."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.design.shaping import VibrationBand
from lbt_synth.design.shaping.specification import violated_demands
from lbt_synth.models import ARModel

LINES = tuple(
    lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=100, direction=d)
    for f, d in ((20, (1, 0)), (31, (0, 1)))
)
WEAK = "modulus margin of at least 0.45"
NARROW = "stability for sensor gains 0.5 to 1.5 and delay errors up to 0.1 frames"


def plant_with(lines, noise_nm=20.0):
    air = ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    return lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=air, vibrations=lines, noise_nm=noise_nm, delay_frames=2
    )


@pytest.fixture(scope="module")
def design():
    bands = [VibrationBand(low_hz=18, high_hz=22, rms_nm=100)]
    plant = plant_with(LINES)
    return lbt.robust(plant, bands=bands, sensor_gain=(0.5, 1.5), functions=16, states=None)


def violated(design, controller):
    return violated_demands(design.specifications, design.hardware, controller)


def test_an_integrator_violates_what_its_margins_say(design):
    low, high = (lbt.integrator(design.hardware, gain=gain) for gain in (0.2, 0.9))
    assert violated(design, low.controller) == violated(design, design.controller) == ()
    assert lbt.loop_margins(lbt.close_loop(design.hardware, high.controller)).modulus < 0.45
    assert violated(design, high.controller) == (WEAK, NARROW)


def test_a_filter_with_poles_outside_the_circle_on_one_axis_is_judged_on_each(design):
    loud = [replace(line, rms_nm=800, damping=0.005) for line in LINES]
    controller = lbt.kalman(plant_with(loud, noise_nm=5.0)).controller
    assert np.max(np.abs(np.linalg.eigvals(controller.A))) > 1
    margins = lbt.loop_margins(lbt.close_loop(design.hardware, controller))
    expected = [WEAK] * (margins.modulus < 0.45)
    expected += [NARROW] * (margins.gain_low > 0.5 or margins.gain_high < 1.5)
    assert list(violated(design, controller)) == expected


def test_coupled_axes_are_not_judged(design):
    across = replace(LINES[0], direction=(np.sqrt(0.5), np.sqrt(0.5)))
    assert violated(design, lbt.kalman(plant_with([across])).controller) is None
