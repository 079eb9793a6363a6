"""Turbulence, vibration, sensor: against closed forms and quadrature of another kind."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import solve_discrete_lyapunov
from scipy.special import jv

import lbt_synth as lbt


def test_tilt_rms_of_the_lbt(air):
    assert air.fried_parameter_m == pytest.approx(0.1258, abs=1e-4)
    assert air.tilt_rms_nm == pytest.approx(591.7, abs=0.5)


def test_tilt_variance_against_adaptive_quadrature(air):
    r0, D = air.fried_parameter_m, 8.22

    def integrand(f):
        bessel = 2 * jv(2, np.pi * D * f) / (np.pi * D * f)
        return f * 0.0228956 * r0 ** (-5 / 3) * (f**2 + 22.0**-2) ** (-11 / 6) * bessel**2

    total = sum(quad(integrand, a, b, limit=400)[0] for a, b in ((1e-9, 0.1), (0.1, 1), (1, 40)))
    variance_rad2 = 2 * np.pi * 2 * total
    assert air.tilt_rms_nm == pytest.approx(np.sqrt(variance_rad2) * 500 / (2 * np.pi), rel=1e-5)


def test_tilt_spectrum_between_the_points_of_its_table(air):
    """By adaptive quadrature over the other spatial frequency."""
    r0, D, V = air.fried_parameter_m, air.diameter_m, air.wind_speed_m_s
    scale = 0.0228956 * r0 ** (-5 / 3) * (500 / (2 * np.pi)) ** 2

    def spatial(fy, fx):
        f = np.hypot(fx, fy)
        tilt = 2 * (4 * jv(2, np.pi * D * f) / (2 * np.pi * D * f)) ** 2
        return scale * (f**2 + 22.0**-2) ** (-11 / 6) * tilt

    # those between two points of the table, in units of V / D
    for x in (0.011, 0.27, 0.8137, 1.9371, 4.4417, 9.97):
        f = x * V / D
        edges = np.concatenate([[0], np.geomspace(1e-3, 40, 60)]) / D
        total = sum(
            quad(spatial, low, high, args=(f / V,), limit=200)[0]
            for low, high in itertools.pairwise(edges)
        )
        assert air.psd(f) == pytest.approx(4 / V * total, rel=2e-5)


def test_kolmogorov_tilt_has_nolls_coefficient():
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=None, wind_speed_m_s=1, diameter_m=8.0)
    # Noll 1976, Table IV: each tilt has the variance 0.449 (D/r0)^(5/3) rad^2
    coefficient = (air.tilt_rms_nm * 2 * np.pi / 500) ** 2 / (8.0 / air.fried_parameter_m) ** (
        5 / 3
    )
    assert coefficient == pytest.approx(0.449, abs=0.002)


def test_annulus_shakes_a_little_more():
    annulus = lbt.Atmosphere(
        seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22, obstruction=0.11
    )
    assert annulus.tilt_rms_nm == pytest.approx(595.3, abs=0.5)


def test_spectrum_integrates_to_the_variance(air):
    f = np.geomspace(1e-5, 400, 100_001)
    assert np.trapezoid(air.psd(f), f) == pytest.approx(air.tilt_rms_nm**2, rel=2e-3)


def test_two_frame_increment_of_frozen_flow(air):
    f = np.geomspace(1e-5, 400, 100_001)
    increment = np.trapezoid(2 * air.psd(f) * (1 - np.cos(2 * np.pi * f * 2 / 800)), f)
    assert np.sqrt(increment) == pytest.approx(10.4, abs=0.1)


def test_spectrum_falls_with_the_power_17_thirds(air):
    slope = np.diff(np.log(air.psd([300.0, 3000.0])))[0] / np.log(10)
    assert slope == pytest.approx(-17 / 3, abs=0.05)


@settings(max_examples=5)
@given(factor=st.floats(0.2, 5))
def test_taylor_wind_only_stretches_time(factor):
    def at(speed):
        return lbt.Atmosphere(
            seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=speed, diameter_m=8.22
        )

    f = np.array([0.3, 1.0, 4.0])
    assert np.allclose(at(20 * factor).psd(f * factor) * factor, at(20).psd(f), rtol=1e-6)


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


def test_vibration_of_the_lbt():
    model = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=1.0).ar_model(800)
    assert model.coefficients == pytest.approx([1.972279, -0.996863], abs=5e-7)
    assert model.driving_rms_nm == pytest.approx(0.012381, abs=5e-7)


@given(frequency=st.floats(1, 399), damping=st.floats(1e-4, 0.9), rms=st.floats(1e-3, 1e6))
def test_vibration_keeps_its_rms(frequency, damping, rms):
    model = lbt.Vibration(frequency_hz=frequency, damping=damping, rms_nm=rms).ar_model(800)
    assert model.rms_nm == pytest.approx(rms, rel=1e-7)


@given(poles=st.lists(st.floats(-0.95, 0.95), min_size=1, max_size=5))
def test_variance_against_a_lyapunov_equation(poles):
    coefficients = -np.poly(poles)[1:]
    model = lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=3.0, frame_rate_hz=1)
    drive = np.zeros((len(poles), len(poles)))
    drive[0, 0] = 9.0
    expected = solve_discrete_lyapunov(model.companion, drive)[0, 0]
    assert model.rms_nm**2 == pytest.approx(expected, rel=1e-6)


def test_ar_spectrum_integrates_to_its_variance():
    model = lbt.Vibration(frequency_hz=40, damping=0.05, rms_nm=7.0).ar_model(800)
    f = np.linspace(0, 400, 400_001)
    assert np.trapezoid(model.psd(f), f) == pytest.approx(49.0, rel=1e-6)


def test_retuned_vibration_holds_what_it_is_told():
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100)
    driving = line.ar_model(800).driving_rms_nm
    held = line.retuned(17, frame_rate_hz=800, hold="driving")
    assert held.ar_model(800).driving_rms_nm == pytest.approx(driving, rel=1e-12)
    assert line.retuned(17, frame_rate_hz=800).rms_nm == 100


def test_direction_becomes_a_unit_vector():
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=1, direction=(3, 4))
    assert line.direction == pytest.approx((0.6, 0.8))


def test_pyramid_noise_of_the_lbt():
    noise = lbt.models.pyramid_tilt_noise_nm(
        photons=50,
        read_noise_electrons=8,
        modulation_lambda_over_d=4,
        subapertures=704,
        wavelength_um=0.75,
        diameter_m=8.22,
    )
    assert noise == pytest.approx(15.5, abs=0.05)


def test_one_mas_is_a_quarter_of_the_diameter():
    assert lbt.models.nm_per_mas(8.22) == pytest.approx(9.963, abs=5e-4)


@pytest.mark.parametrize(
    "make",
    [
        lambda v: lbt.Vibration(frequency_hz=v, damping=0.1, rms_nm=1),
        lambda v: lbt.Vibration(frequency_hz=1, damping=v, rms_nm=1),
        lambda v: lbt.Vibration(frequency_hz=1, damping=0.1, rms_nm=v),
        lambda v: lbt.models.SinusoidalVibration(frequency_hz=1, rms_nm=v),
        lambda v: lbt.models.ARModel(coefficients=[v], driving_rms_nm=1, frame_rate_hz=1),
        lambda v: lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=v, frame_rate_hz=1),
        lambda v: lbt.Truth(turbulence=None, noise_nm=v),
        lambda v: lbt.Truth(turbulence=None, sensor_gain=v),
        lambda v: lbt.Imaging(diameter_m=v),
        lambda v: lbt.LoopHardware(frame_rate_hz=v),
        lambda v: lbt.LoopHardware(frame_rate_hz=1, delay_frames=v),
        lambda v: lbt.models.nm_per_mas(v),
        lambda v: lbt.models.TabulatedSpectrum(frequency_hz=[0, v], density_nm2_hz=[1, 1]),
    ],
)
@pytest.mark.parametrize("value", [np.nan, np.inf, -2.0])
def test_impossible_values_are_refused(make, value):
    with pytest.raises(lbt.errors.ProblemError):
        make(value)


@pytest.mark.parametrize("damping", [0.0, 1.0, 1.5])
def test_damping_lies_in_the_open_interval(damping):
    with pytest.raises(lbt.errors.ProblemError, match="damping must be"):
        lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=1)


def test_a_vibration_above_nyquist_is_refused():
    with pytest.raises(
        lbt.errors.ProblemError, match="below the Nyquist frequency 400 Hz; got 500 Hz"
    ):
        lbt.Vibration(frequency_hz=500, damping=0.1, rms_nm=1).ar_model(800)


def test_the_papers_literal_sign_is_refused():
    a1, a2 = 1.972279, 0.996863  # erratum 1: + A2
    with pytest.raises(lbt.errors.ProblemError, match="Check the signs"):
        lbt.models.ARModel(coefficients=[a1, a2], driving_rms_nm=1, frame_rate_hz=800)


def test_a_truth_needs_a_spectrum():
    with pytest.raises(lbt.errors.ProblemError, match="psd"):
        lbt.Truth(turbulence=3.0)


@pytest.mark.parametrize(
    ("frequency", "density", "text"),
    [
        ([1, 2, 3], [1, 1], "same length"),
        ([2, 1], [1, 1], "increase"),
        ([1, 2], [1, -1], "at least 0"),
    ],
)
def test_spectrum_tables_are_checked(frequency, density, text):
    with pytest.raises(lbt.errors.ProblemError, match=text):
        lbt.models.TabulatedSpectrum(frequency_hz=frequency, density_nm2_hz=density)
