"""Spectra of processes, and sums of spectra."""

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov

import lbt_synth as lbt
from lbt_synth.models import ARModel, Spectrum, SumSpectrum, TabulatedSpectrum
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
