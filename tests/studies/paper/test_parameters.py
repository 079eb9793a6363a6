"""Parameters that follow from the paper's Table I."""

import pytest

import lbt_synth as lbt
from lbt_synth.studies.paper import parameters as given


def test_parameters_that_are_called_derived(air):
    assert given.VIBRATION_NM == pytest.approx(797, abs=0.5)
    noise = lbt.models.pyramid_tilt_noise_nm(
        photons=50,
        read_noise_electrons=8,
        modulation_lambda_over_d=4,
        subapertures=704,
        wavelength_um=0.75,
        diameter_m=given.DIAMETER_M,
    )
    assert pytest.approx(noise, abs=0.05) == given.NOISE_NM
    assert given.turbulence_model().rms_nm == pytest.approx(air.tilt_rms_nm)
    assert given.ATMOSPHERE == air
