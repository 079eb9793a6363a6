"""Terms of an objective, against the residual of the real loop."""

from dataclasses import replace

import numpy as np
import pytest
from support.shaping import AIR, BASIC, NOISE, ONE, channel, random_coefficients, shaped, spec

import lbt_synth as lbt
from lbt_synth.design.shaping import CommandRms, ResidualVariance, VibrationBand
from lbt_synth.design.shaping.channel import SingleModeLoop, mode_loop
from lbt_synth.linear.convex_functions import total_value

BAND = VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797)
TERMS = [
    BASIC,
    replace(BASIC, sensor_gain=0.5),
    ResidualVariance(turbulence=AIR, noise_nm=15.5, sensor_gain=1.2),
    ResidualVariance(turbulence=None, noise_nm=15.5),
    BAND,
    replace(BAND, sensor_gain=0.6),
    replace(BAND, damping=0.02),
]


@pytest.mark.parametrize("delay", [1.0, 2.5])
@pytest.mark.parametrize("term", TERMS, ids=lambda t: t.label)
def test_a_term_over_the_grid_is_the_residual_of_the_real_loop(term, delay):
    mode = channel(delay=delay)
    c = random_coefficients(12) * 0.5
    value = total_value(term.function(mode, spec(terms=[term]).grid(mode, fineness=2)), c)
    exact = term.measured_nm2(mode_loop(mode.hardware, mode.basis.parameter(c)))
    assert value == pytest.approx(exact, rel=2e-3)


def residual_of_resonance(loop, frequency_hz, damping, rms_nm):
    line = lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=rms_nm, direction=(1,))
    truth = lbt.Truth(turbulence=None, vibrations=(line,))
    return lbt.residual_budget(loop, truth, frame_means=True).rms_nm ** 2


@pytest.mark.parametrize("frequency_hz", [16.5, 20.0, 23.5])
def test_a_band_with_damping_bounds_a_resonance_anywhere_in_it(frequency_hz):
    mode, band = channel(delay=2.0), replace(BAND, damping=0.02)
    loop = mode_loop(mode.hardware, mode.basis.parameter(random_coefficients(12) * 0.5))
    residual_nm2 = residual_of_resonance(loop.at(1.0), frequency_hz, 0.02, 797)
    assert residual_nm2 < band.measured_nm2(loop) < 3 * residual_nm2
    assert BAND.skirts(1000) is None


def test_a_band_bounds_a_wide_resonance_in_a_loop_that_only_removes_its_top():
    line = lbt.Vibration(frequency_hz=300.0, damping=1e-3, rms_nm=100, direction=(1,))
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=1, frame_rate_hz=1000)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=1000, turbulence=slow, vibrations=[line], noise_nm=10, modes=1
    )
    loop = SingleModeLoop(hardware=plant.hardware, controller=lbt.kalman(plant).controller)
    band = VibrationBand(low_hz=299.9, high_hz=300.1, rms_nm=100, damping=0.3)
    residual_nm2 = residual_of_resonance(loop.at(1.0), 300.0, 0.3, 100)
    assert residual_nm2 < band.measured_nm2(loop) < 1.01 * residual_nm2


def test_skirts_are_those_of_the_resonance_at_the_nearer_end():
    low, high = (
        lbt.Vibration(frequency_hz=f, damping=0.02, rms_nm=797, direction=(1,)).ar_model(200)
        for f in (16.5, 23.5)
    )
    f = np.array([2.0, 12.0, 16.0, 24.0, 30.0, 100.0])
    skirts = replace(BAND, damping=0.02).skirts(200)
    np.testing.assert_allclose(skirts.psd(f), np.where(f < 20, low.psd(f), high.psd(f)), rtol=1e-12)
    assert not skirts.psd([16.5, 20.0, 23.5]).any()


def test_a_narrow_line_of_a_tabulated_spectrum_is_not_missed():
    f0, w = 53.0, 1e-3  # 100 nm rms
    line = lbt.models.TabulatedSpectrum(
        frequency_hz=[1, f0 - w, f0, f0 + w, 300], density_nm2_hz=[1e-3, 1e-3, 1e4 / w, 1e-3, 1e-3]
    )
    bounded = shaped(CommandRms(at_most_nm=10, turbulence=line, noise_nm=1e-3))
    loop = lbt.close_loop(ONE, bounded.controller)
    assert 100 * abs(loop.commanding().frequency_response([f0])[0, 0, 1]) < 10
    rejecting = shaped(terms=[ResidualVariance(turbulence=line, noise_nm=NOISE)], functions=30)
    residual = 100 * abs(lbt.close_loop(ONE, rejecting.controller).sensitivity([f0])[0, 0, 0])
    assert residual < rejecting.objective_nm[0]
