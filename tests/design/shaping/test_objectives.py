"""Terms of an objective, against the residual of the real loop."""

from dataclasses import replace

import numpy as np
import pytest
from support.shaping import (
    AIR,
    BASIC,
    NOISE,
    ONE,
    channel,
    random_coefficients,
    spec,
)

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import SingleModeLoop, mode_loop

TERMS = [
    BASIC,
    replace(BASIC, sensor_gain=0.5),
    lbt.design.shaping.ResidualVariance(turbulence=AIR, noise_nm=15.5, sensor_gain=1.2),
    lbt.design.shaping.ResidualVariance(turbulence=None, noise_nm=15.5),
    lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797),
    lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797, sensor_gain=0.6),
    lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797, damping=0.02),
    lbt.design.shaping.Total(
        terms=(BASIC, lbt.design.shaping.VibrationBand(low_hz=5, high_hz=9, rms_nm=30)),
        weights=(1, 2),
    ),
    lbt.design.shaping.Worst(
        terms=(BASIC, lbt.design.shaping.VibrationBand(low_hz=5, high_hz=9, rms_nm=30)),
        weights=(0.1, 2),
    ),
]


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.5, 3.0])
@pytest.mark.parametrize("term", TERMS, ids=lambda t: getattr(t, "label", type(t).__name__))
def test_a_term_over_the_grid_is_the_residual_of_the_real_loop(term, delay):
    mode = channel(delay=delay)
    c = random_coefficients(12) * 0.5
    found = term.function(mode, spec(objective=term).grid(mode, fineness=2)).value(c)
    exact = term.measured_nm2(mode_loop(mode.hardware, mode.basis.parameter(c)))
    assert found == pytest.approx(exact, rel=2e-3)


@pytest.mark.parametrize("frequency_hz", [16.5, 18.0, 20.0, 23.5])
def test_a_band_with_damping_bounds_a_resonance_anywhere_in_it(frequency_hz):
    mode, damping = channel(delay=2.0), 0.02
    band = lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797, damping=damping)
    loop = mode_loop(mode.hardware, mode.basis.parameter(random_coefficients(12) * 0.5))
    left_nm2 = left_of_resonance(loop.at(1.0), frequency_hz, damping, 797)
    assert left_nm2 < band.measured_nm2(loop) < 3 * left_nm2
    assert replace(band, damping=0.0).skirts(1000) is None


@pytest.mark.parametrize("frequency_hz", [100.0, 300.0])
def test_a_band_bounds_a_wide_resonance_in_a_loop_that_only_removes_its_top(frequency_hz):
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=1000,
        turbulence=lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=1, frame_rate_hz=1000),
        vibrations=[
            lbt.Vibration(frequency_hz=frequency_hz, damping=1e-3, rms_nm=100, direction=(1,))
        ],
        noise_nm=10,
        modes=1,
    )
    loop = SingleModeLoop(hardware=plant.hardware, controller=lbt.kalman(plant).controller)
    band = lbt.design.shaping.VibrationBand(
        low_hz=frequency_hz - 0.1, high_hz=frequency_hz + 0.1, rms_nm=100, damping=0.3
    )
    left_nm2 = left_of_resonance(loop.at(1.0), frequency_hz, 0.3, 100)
    assert left_nm2 < band.measured_nm2(loop) < 1.01 * left_nm2


def left_of_resonance(loop, frequency_hz, damping, rms_nm):
    line = lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=rms_nm, direction=(1,))
    truth = lbt.Truth(turbulence=None, vibrations=(line,))
    return lbt.residual_budget(loop, truth, frame_means=True).rms_nm ** 2


def test_skirts_are_those_of_the_resonance_at_the_nearer_end():
    band = lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797, damping=0.02)
    low, high = (
        lbt.Vibration(frequency_hz=f, damping=0.02, rms_nm=797, direction=(1,)).ar_model(200)
        for f in (16.5, 23.5)
    )
    f = np.array([2.0, 12.0, 16.0, 24.0, 30.0, 100.0])
    expected = np.where(f < 20, low.psd(f), high.psd(f))
    skirts = band.skirts(200)
    np.testing.assert_allclose(skirts.psd(f), expected, rtol=1e-12)
    assert not skirts.psd([16.5, 20.0, 23.5]).any()


def test_a_narrow_line_of_a_tabulated_spectrum_is_not_missed():
    f0, w = 53.0, 1e-3  # 100 nm rms
    line = lbt.models.TabulatedSpectrum(
        frequency_hz=[1, f0 - w, f0, f0 + w, 300], density_nm2_hz=[1e-3, 1e-3, 1e4 / w, 1e-3, 1e-3]
    )
    bound = lbt.design.shaping.CommandRms(at_most_nm=10, turbulence=line, noise_nm=1e-3)
    design = lbt.design.shape(ONE, spec(bound), functions=20, states=None)
    loop = lbt.close_loop(ONE, design.controller)
    assert 100 * abs(loop.commanding().frequency_response([f0])[0, 0, 1]) < 10
    seen = lbt.design.shaping.ResidualVariance(turbulence=line, noise_nm=NOISE)
    rejecting = lbt.design.shape(ONE, spec(objective=seen), functions=30, states=None)
    left = 100 * abs(lbt.close_loop(ONE, rejecting.controller).sensitivity([f0])[0, 0, 0])
    assert left < rejecting.objective_nm[0]


def test_a_specification_knows_the_bands_of_its_objective():
    band = lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797)
    assert lbt.design.shaping.Specification(objective=band, demands=()).bands_hz == ((16.5, 23.5),)
