"""AR models of the turbulence: Le Roux poles, and fits of order two."""

from __future__ import annotations

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
    found = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=1.0)
    assert found.coefficients == pytest.approx(made.coefficients, abs=1e-5)
    assert found.driving_rms_nm == pytest.approx(0.8, rel=1e-3)
