"""What a design expects, against the variances of its model."""

import numpy as np
import pytest
from scipy.integrate import quad
from support.plants import lbt_axis_plant

import lbt_synth as lbt

AIR = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)


@pytest.mark.parametrize("design", [lbt.kalman, lambda plant: lbt.kalman(plant.full())])
def test_a_filter_expects_the_variance_of_its_model(design):
    plant = lbt_axis_plant()
    (found,) = design(plant).expected_disturbance()
    (line,) = plant.vibrations
    f = line.frequency_hz
    near = quad(lambda x: found.spectrum.psd([x])[0], 0, 400, points=[f], limit=400)[0]
    whole = plant.turbulence[0].rms_nm ** 2 + line.rms_nm**2
    assert near == pytest.approx(whole, rel=1e-4)


def test_a_shaped_design_expects_its_spectra_bands_and_skirts():
    plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=AIR, noise_nm=20.0, modes=1)
    band = lbt.design.shaping.VibrationBand(low_hz=18, high_hz=22, rms_nm=100, damping=0.01)
    design = lbt.robust(
        plant,
        bands=[band],
        scenarios=[1.0, 0.7],
        sensor_gain=(0.6, 1.2),
        functions=16,
        states=None,
    )
    (found,) = design.expected_disturbance()
    assert found.bands == (band,)
    f = np.array([10.0, 20.0, 40.0])
    expected = plant.turbulence[0].psd(f) + band.skirts(800).psd(f)
    np.testing.assert_allclose(found.spectrum.psd(f), expected)


def test_an_integrator_and_a_bare_filter_expect_nothing_of_a_loop():
    plain = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4)
    assert plain.expected_disturbance() is None
    bare = lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    assert lbt.kalman(bare).expected_disturbance() is None
