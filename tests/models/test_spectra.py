"""Spectra of processes and resonances, their derivatives, and sums of spectra."""

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid
from scipy.linalg import solve_discrete_lyapunov

import lbt_synth as lbt
from lbt_synth.models import ARModel, Spectrum, SumSpectrum, TabulatedSpectrum
from lbt_synth.models.resonance_spectrum import (
    coefficient_rows,
    drive_ratio,
    log_roll_off,
    resonance_densities,
    unit_densities,
)
from lbt_synth.models.spectra import spectrum_groups


def test_sum_of_spectra():
    slow = ARModel(coefficients=[0.99], driving_rms_nm=2.0, frame_rate_hz=500)
    table = TabulatedSpectrum(frequency_hz=[10, 20, 40], density_nm2_hz=[1, 5, 2])
    other = TabulatedSpectrum(frequency_hz=[20, 30], density_nm2_hz=[7, 7])
    total = SumSpectrum(parts=[slow, SumSpectrum(parts=[table, other])])
    f = np.array([5.0, 15.0, 25.0, 100.0])
    assert total.psd(f) == pytest.approx(slow.psd(f) + np.array([0, 3, 4.25 + 7, 0]))
    assert total.parts == (slow, table, other)
    assert total.breakpoints_hz.tolist() == [10, 20, 30, 40]
    assert isinstance(total, Spectrum)
    path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller)
    powers = [
        lbt.residual_budget(loop, lbt.Truth(turbulence=spectrum), frame_means=True).rms_nm ** 2
        for spectrum in (total, slow, table, other)
    ]
    assert powers[0] == pytest.approx(sum(powers[1:]), rel=1e-9)


@settings(max_examples=10)
@given(poles=st.lists(st.floats(-0.95, 0.95), min_size=1, max_size=5))
def test_variance_against_a_lyapunov_equation(poles):
    model = ARModel(coefficients=-np.poly(poles)[1:], driving_rms_nm=3.0, frame_rate_hz=1)
    drive = np.diag(9.0 * np.eye(len(poles))[0])
    expected = solve_discrete_lyapunov(model.companion, drive)[0, 0]
    assert model.rms_nm**2 == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("frequency_hz", "damping", "rate_hz"), [(0.5, 1e-6, 10_000), (0.1, 1e-3, 2000), (40, 0.9, 800)]
)
def test_slow_lines_have_the_rms_they_claim(frequency_hz, damping, rate_hz):
    """By the closed form of order 2, in 50 digits, from the same coefficients."""
    line = lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=100)
    model = line.ar_model(rate_hz)
    with mpmath.workdps(50):
        a1, a2, drive = (mpmath.mpf(float(v)) for v in (*model.coefficients, model.driving_rms_nm))
        variance = drive**2 * (1 - a2) / ((1 + a2) * ((1 - a2) ** 2 - a1**2))
        assert float(mpmath.sqrt(variance)) == pytest.approx(100, rel=1e-8)
    assert model.rms_nm == pytest.approx(100, rel=1e-12)


def test_modes_are_grouped_by_all_numbers_of_their_models():
    slow = {"coefficients": [0.9], "driving_rms_nm": 1.0, "frame_rate_hz": 800}
    changes = ({}, {"driving_rms_nm": 2.0}, {}, {"frame_rate_hz": 500}, {"coefficients": [0.8]})
    models = [ARModel(**(slow | change)) for change in changes]
    table = TabulatedSpectrum(frequency_hz=[1, 2], density_nm2_hz=[1, 1])
    groups = spectrum_groups([*models, None, table, table])
    assert [modes for _, modes in groups] == [[0, 2], [1], [3], [4], [6, 7]]


def log_slope(function, value, step=1e-5):
    """Return the derivative by the logarithm of a value, by central differences."""
    return (function(value * np.exp(step)) - function(value * np.exp(-step))) / (2 * step)


def log_density(frequency, damping, s, sections=1):
    """Return the logarithm of the spectrum of unit variance."""
    return np.log(unit_densities([frequency], [damping], s, [sections])[0])


def require_slopes(frequency, damping, s, sections=1):
    """Hold both slopes of a spectrum against differences of its logarithm."""
    one = np.ones(1)
    _, slopes = resonance_densities(frequency * one, damping * one, one, s, [sections])
    by_frequency = log_slope(lambda w: log_density(w, damping, s, sections), frequency)
    by_damping = log_slope(lambda z: log_density(frequency, z, s, sections), damping)
    numeric = np.stack([by_frequency, by_damping])
    limit = 1e-5 * (1 + np.max(np.abs(numeric), axis=1, keepdims=True))
    assert np.all(np.abs(slopes[0] - numeric) <= limit)


@given(
    frequency=st.floats(6e-5, 2.5), damping=st.floats(1e-4, 20).filter(lambda z: abs(z - 1) > 1e-6)
)
@settings(max_examples=20)
def test_density_is_that_of_the_process_and_its_derivatives_are_right(frequency, damping):
    w = 2 * np.pi * np.array([2e-5, 7e-4, 5e-3, 0.06, 0.333, 0.499])
    s = 4 * np.sin(w / 2) ** 2
    a1, a2 = coefficient_rows(np.array(frequency), np.array(damping))
    # the direct formula loses digits to cancellation where the frequency is small
    modulus = np.abs(1 - a1 * np.exp(-1j * w) - a2 * np.exp(-2j * w))
    direct = np.log(drive_ratio(frequency, damping)) - 2 * np.log(modulus)
    close = 4e-15 / frequency**2 + 1e-8
    assert log_density(frequency, damping, s) == pytest.approx(direct, abs=close)
    require_slopes(frequency, damping, s)


@pytest.mark.parametrize(
    ("frequency", "damping", "sections"),
    [
        *((0.126, damping, 1) for damping in (0.05, 1 - 1e-9, 1 + 1e-9, 3.0)),
        *((0.25, 0.02, 2), (1.0, 0.3, 4), (2.9, 0.2, 2), (0.02, 0.5, 4)),
    ],
)
def test_density_has_unit_variance_and_right_slopes(frequency, damping, sections):
    w = np.linspace(0, np.pi, 200_001)
    s = 4 * np.sin(w / 2) ** 2
    density = unit_densities([frequency], [damping], s, [sections])[0]
    assert trapezoid(density, w) == pytest.approx(np.pi)
    require_slopes(frequency, damping, s[::500], sections)


@pytest.mark.parametrize("corner", [1e-3, 0.2, 3.0])
def test_roll_off_has_unit_gain_at_zero_and_a_right_derivative(corner):
    s = np.array([0.0, 1e-4, 0.5, 4.0])
    value, slope = log_roll_off(corner, 5 / 6, s)
    assert value[0] == 0
    numeric = log_slope(lambda c: log_roll_off(c, 5 / 6, s)[0], corner, 1e-6)
    assert slope == pytest.approx(numeric, abs=1e-8)
