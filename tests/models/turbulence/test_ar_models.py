"""AR models of the turbulence: Le Roux poles, and fits of order two."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt


def test_le_roux_pole():
    pole = lbt.models.le_roux_pole(wind_speed_m_s=20, diameter_m=8.22, frame_rate_hz=800)
    assert pole == pytest.approx(0.98860, abs=5e-6)


def test_ar1_is_stationary_with_the_von_karman_variance(air):
    model = lbt.models.ar1_turbulence(air, frame_rate_hz=800)
    assert model.rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-12)


def test_ar2_fit_of_the_lbt(air):
    model = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=15.5)
    assert model.coefficients == pytest.approx([1.997477, -0.997555], abs=2e-5)


def test_ar2_fit_returns_the_model_that_made_the_spectrum(monkeypatch, air):
    made = lbt.models.ARModel(coefficients=[1.99, -0.992], driving_rms_nm=0.8, frame_rate_hz=800)
    monkeypatch.setattr(type(air), "psd", lambda _self, f: made.psd(f))
    monkeypatch.setattr(type(air), "tilt_rms_nm", made.rms_nm)
    found = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=1.0)
    assert found.coefficients == pytest.approx(made.coefficients, abs=1e-5)
    assert found.driving_rms_nm == pytest.approx(0.8, rel=1e-3)


@pytest.mark.parametrize(("outer_scale_m", "wind_m_s"), [(30, 16.5), (40, 16.0)])
def test_ar2_fit_is_not_a_line_between_two_nodes(outer_scale_m, wind_m_s):
    air = lbt.Atmosphere(
        seeing_arcsec=0.8, outer_scale_m=outer_scale_m, wind_speed_m_s=wind_m_s, diameter_m=8.22
    )
    model = lbt.models.ar2_turbulence(air, frame_rate_hz=500, noise_nm=1.0)
    assert model.rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-6)
    frequency = (np.arange(20_000) + 0.5) / 80
    white = 2 / 500
    target = air.psd(frequency) + white

    def contrast(made: lbt.ARModel) -> float:
        spectrum = made.psd(frequency) + white
        return float(np.mean(np.log(spectrum) + target / spectrum))

    others = [
        lbt.Vibration(frequency_hz=f, damping=damping, rms_nm=air.tilt_rms_nm).ar_model(500)
        for f in np.geomspace(0.5, 3, 9)
        for damping in (0.02, 0.04, 0.06, 0.1, 0.4)
    ]
    assert contrast(model) < min(map(contrast, others))


def test_ar2_fit_of_an_atmosphere_that_takes_many_steps():
    air = lbt.Atmosphere(
        seeing_arcsec=0.552013095527444,
        outer_scale_m=11.007068525910793,
        wind_speed_m_s=2.7861543721165756,
        diameter_m=1.392828858735345,
    )
    found = lbt.models.ar2_turbulence(
        air, frame_rate_hz=1771.8517360710612, noise_nm=71.35054707271983
    )
    assert found.rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-6)


def test_noise_that_hides_the_turbulence_is_named():
    """A line without damping would explain it as well: nothing is left to fit."""
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
    for noise_nm in (1e5, 1e12):
        with pytest.raises(lbt.errors.NumericalError, match="the noise hides the turbulence"):
            lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=noise_nm)
    loud = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=1e4)
    assert loud.rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-5)
