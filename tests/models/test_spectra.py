"""Spectra in tables, and sums of spectra."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.models.spectra import spectrum_groups


def test_sum_of_spectra():
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=2.0, frame_rate_hz=500)
    table = lbt.models.TabulatedSpectrum(frequency_hz=[10, 20, 40], density_nm2_hz=[1, 5, 2])
    other = lbt.models.TabulatedSpectrum(frequency_hz=[20, 30], density_nm2_hz=[7, 7])
    whole = lbt.models.SumSpectrum(parts=[slow, lbt.models.SumSpectrum(parts=[table, other])])
    f = np.array([5.0, 15.0, 25.0, 100.0])
    assert whole.psd(f) == pytest.approx(slow.psd(f) + np.array([0, 3, 4.25 + 7, 0]))
    assert whole.parts == (slow, table, other)
    assert whole.breakpoints_hz.tolist() == [10, 20, 30, 40]
    assert isinstance(whole, lbt.models.Spectrum)
    path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller)
    left = [
        lbt.residual_budget(loop, lbt.Truth(turbulence=part), frame_means=True).rms_nm ** 2
        for part in (whole, slow, table, other)
    ]
    assert left[0] == pytest.approx(sum(left[1:]), rel=1e-9)


def test_what_is_no_spectrum_is_refused():
    total, table = lbt.models.SumSpectrum, lbt.models.TabulatedSpectrum
    rows = [
        (lambda: total(parts=[]), "at least one"),
        (lambda: total(parts=[3.0]), "psd"),
        (lambda: total(parts=3.0), "must be a list"),
        (lambda: table(frequency_hz=[1, 2, 3], density_nm2_hz=[1, 1]), "same length"),
        (lambda: table(frequency_hz=[2, 1], density_nm2_hz=[1, 1]), "increase"),
        (lambda: table(frequency_hz=[1, 2], density_nm2_hz=[1, -1]), "at least 0"),
    ]
    require_refusals((call, lbt.errors.ProblemError, words) for call, words in rows)


@settings(max_examples=10)
@given(poles=st.lists(st.floats(-0.95, 0.95), min_size=1, max_size=5))
def test_variance_against_a_lyapunov_equation(poles):
    coefficients = -np.poly(poles)[1:]
    model = lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=3.0, frame_rate_hz=1)
    drive = np.zeros((len(poles), len(poles)))
    drive[0, 0] = 9.0
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


def test_processes_that_are_not_stationary_are_refused():
    for a1, a2, words in (
        (1.972279, 0.996863, "Check the signs"),  # erratum 1 of the paper: + A2
        (1.9, -1.0, "no finite variance"),  # rounding leaves its poles inside the unit circle
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            lbt.models.ARModel(coefficients=[a1, a2], driving_rms_nm=1, frame_rate_hz=500)


def test_modes_are_grouped_by_all_numbers_of_their_models():
    slow = {"coefficients": [0.9], "driving_rms_nm": 1.0, "frame_rate_hz": 800}
    changes = ({}, {"driving_rms_nm": 2.0}, {}, {"frame_rate_hz": 500}, {"coefficients": [0.8]})
    models = [lbt.models.ARModel(**(slow | change)) for change in changes]
    table = lbt.models.TabulatedSpectrum(frequency_hz=[1, 2], density_nm2_hz=[1, 1])
    groups = spectrum_groups([*models, None, table, table])
    assert [modes for _, modes in groups] == [[0, 2], [1], [3], [4], [6, 7]]
