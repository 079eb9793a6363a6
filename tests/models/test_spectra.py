"""Spectra in tables, and sums of spectra."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from support.eris import eris_example, eris_record

import lbt_synth as lbt


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
    for call, words in (
        (lambda: total(parts=[]), "at least one"),
        (lambda: total(parts=[3.0]), "psd"),
        (lambda: total(parts=3.0), "must be a list"),
        (lambda: table(frequency_hz=[1, 2, 3], density_nm2_hz=[1, 1]), "same length"),
        (lambda: table(frequency_hz=[2, 1], density_nm2_hz=[1, 1]), "increase"),
        (lambda: table(frequency_hz=[1, 2], density_nm2_hz=[1, -1]), "at least 0"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            call()


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return eris_example()


@pytest.fixture(scope="module")
def seen() -> lbt.identification.SpectrumRecord:
    return eris_record()


def test_parts_of_the_disturbance_are_the_file(seen, example):
    met = example.disturbance(seen)
    f = np.concatenate([seen.frequency_hz, seen.frequency_hz[:-1] + 0.009])
    for i, column in enumerate(seen.spectra):
        whole = lbt.models.SumSpectrum(parts=[met.background[i], met.lines[i]])
        assert whole.psd(f) == pytest.approx(column.psd(f), rel=1e-12)
        moved = example.disturbance(seen, shift_hz=0.5).lines[i]
        assert moved.psd(f + 0.5) == pytest.approx(met.lines[i].psd(f), rel=1e-9, abs=1e-9)
