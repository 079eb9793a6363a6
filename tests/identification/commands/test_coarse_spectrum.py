"""The coarse spectrum: transforms, bands, and the likelihood of repaired commands."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from lbt_synth.identification.commands.coarse_spectrum import (
    _segments,
    coarse_axis,
    find_spectral_peaks,
    fit_guesses,
)
from lbt_synth.identification.fit.periodogram import segment_transforms

RATE, FRAMES = 1000.0, 24_000


def coarse_transforms(series: np.ndarray, stretches: list, rate: float) -> tuple:
    return segment_transforms(series, _segments(stretches, rate), rate, levelled=True)


def white(seed: int, n: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((FRAMES, n))


def axis_of(y: np.ndarray, guesses: np.ndarray) -> tuple:
    """The coarse axis of one measurement (frames,) and guesses (frames, n)."""
    f, z, n = coarse_transforms(np.column_stack([y, guesses]), [(0, FRAMES)], RATE)
    return coarse_axis(f, z[0], z[1:], independent=n, frame_rate_hz=RATE)


def test_the_contrast_of_white_noise_lies_between_its_bounds() -> None:
    bands, peaks, shapes = axis = axis_of(white(2)[:, 0], 0 * white(3))
    (contrast,), _ = fit_guesses(axis, np.ones((1, 1)))
    assert np.max(shapes) <= 1
    power, count = bands.measured, bands.count
    rest = np.sum(peaks.count * (np.log(peaks.measured) + 1))
    least = np.sum(count * (np.log(power) + 1)) + rest
    mean = np.average(power, weights=count)
    only_noise = np.sum(count) * (np.log(mean) + 1) + rest
    assert least < contrast <= only_noise + 0.1


def test_the_right_correction_is_found_with_its_gain() -> None:
    slow = lfilter([20], [1, -0.99], white(4)[:, 0])
    noise = 5 * white(5)[:, 0]
    y, u = np.zeros((2, FRAMES))
    for k in range(2, FRAMES):
        y[k] = 0.6 * (slow[k - 1] - u[k - 2]) + noise[k]
        u[k] = u[k - 1] + 0.5 * y[k]
    guesses = np.column_stack([np.roll(u, 2), 1e-3 * np.roll(u, 2), np.roll(u, 3), -np.roll(u, 2)])
    starts = np.array([[0.3, 1.0], [300.0, 1000.0], [0.3, 1.0], [0.3, 1.0]])
    contrast, gain = fit_guesses(axis_of(y, guesses), starts)
    assert gain[0] == pytest.approx(0.6, rel=0.1)
    assert gain[1] == pytest.approx(1000 * gain[0], rel=0.01)
    assert contrast[1] == pytest.approx(contrast[0], abs=0.5)
    assert np.all(contrast[2:] > contrast[0] + 100)


def test_slow_loops_have_whole_segments():
    """Six seconds are few frames there, or none: 0.8 may be a rate in kHz."""
    rate_hz = 0.8
    series = np.random.default_rng(0).standard_normal((2000, 1))
    f, z, independent = coarse_transforms(series, [(0, 1500)], rate_hz)
    assert z.shape == (1, 2, f.size)
    assert f.size == 255
    density = np.mean(np.abs(z) ** 2)
    assert density == pytest.approx(2 / rate_hz, rel=0.1)  # of white noise of variance 1
    assert independent > 1


def test_peaks_are_the_lines_of_a_spectrum():
    rng = np.random.default_rng(1)
    frequency = np.arange(1, 2000) / 6
    lines = [40 / (1 + (frequency - f) ** 2) for f in (60, 200)]
    power = 1e3 / frequency**2 + 1 + lines[0] + lines[1]
    scatter = rng.gamma(8.0, 1 / 8.0, frequency.size)
    is_peak, places, width = find_spectral_peaks(frequency, power * scatter)
    assert [min(abs(places - f)) < 1 for f in (60, 200)] == [True, True]
    assert np.all(width > 0)
    assert is_peak[np.searchsorted(frequency, [60, 200])].all()
    assert np.mean(is_peak) < 0.2
