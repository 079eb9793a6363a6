"""Measurement noise of the pyramid sensor."""

import pytest

import lbt_synth as lbt


def test_one_mas_is_a_quarter_of_the_diameter():
    assert lbt.models.nm_per_mas(8.22) == pytest.approx(9.963, abs=5e-4)


def test_bad_modal_noise_is_refused():
    with pytest.raises(lbt.errors.ProblemError, match="tilt_noise_nm"):
        lbt.models.pyramid_modal_noise_nm(0, modes=3, modulation_lambda_over_d=4)
    with pytest.raises(lbt.errors.ProblemError, match="modulation"):
        lbt.models.pyramid_modal_noise_nm(1, modes=3, modulation_lambda_over_d=0)
