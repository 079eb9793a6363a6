"""Simulations of a report beside the exact answer."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.report.designs.simulation import exact_spectrum, run_spectra


def test_simulations_agree_with_the_exact_answer(report):
    for one in report.stable:
        exact = lbt.residual_budget(one.loop, report.config.truth)
        residual_nm = np.sqrt(np.mean(one.run.rms_nm**2))
        assert residual_nm == pytest.approx(exact.rms_nm, rel=0.15)
        f, _, simulated, expected = run_spectra(one.run, one.loop, report.config.truth)
        ratio = (simulated / expected)[f > 5]
        assert np.mean(ratio) == pytest.approx(1, abs=0.06)
        assert np.ptp(one.run_strehls) > 0


def test_the_exact_spectrum_has_the_exact_power():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    design = lbt.integrator(path, gain=0.4)
    slow = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=10.0, frame_rate_hz=800)
    shake = lbt.Vibration(frequency_hz=60, damping=0.05, rms_nm=40, direction=(1,))
    line = lbt.models.SinusoidalVibration(frequency_hz=31.7, rms_nm=30.0, direction=(1,))
    truth = lbt.Truth(turbulence=slow, vibrations=(shake, line), noise_nm=5.0)
    loop = lbt.close_loop(path, design.controller)
    length = 2048
    grid = np.arange(length // 2 + 1) * 800 / length
    density = exact_spectrum(loop, truth, grid, length)
    power = np.sum(density[1:-1]) * 800 / length  # the ends hold half a bin
    exact = lbt.residual_budget(loop, truth)
    means_nm = np.sqrt(exact.rms_nm**2 - exact.within_nm**2)
    assert np.sqrt(power) == pytest.approx(means_nm, rel=2e-3)
