"""How the taper smears lines: the integral that defines it, derivatives, reach, a sinusoid."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, trapezoid

from lbt_synth.identification.fit.periodogram import TAPER, loop_periodogram
from lbt_synth.identification.fit.smearing import WIDE, log_smearing, smearing_reach


def taper(x: float) -> float:
    """Return the taper at a part of its length, by its definition."""
    edge = min(x, 1 - x)
    if edge < 0:
        return 0.0
    return 1.0 if edge >= TAPER / 2 else 0.5 * (1 - math.cos(2 * math.pi * edge / TAPER))


@cache
def correlations() -> tuple[np.ndarray, np.ndarray]:
    """Return lags and the autocorrelation of the taper at them."""
    t = np.linspace(0, 1, 1201)
    products = [
        quad(lambda x, lag=lag: taper(x) * taper(x + lag), 0, 1 - lag, limit=400)[0] for lag in t
    ]
    return t, np.array(products) / products[0]


@pytest.mark.parametrize(("width", "distance"), [(0.02, 0.4), (0.3, 1.3), (2.0, 0.0), (8.0, 5.0)])
def test_smearing_is_the_integral_that_defines_it(width: float, distance: float) -> None:
    t, r = correlations()
    kernel = r * np.exp(-2 * np.pi * width * t) * np.cos(2 * np.pi * distance * t)
    smeared = 2 * trapezoid(kernel, t)
    line = width / np.pi / (width**2 + distance**2)
    found = log_smearing(width, np.array([distance]))[0][0]
    assert found == pytest.approx(np.log(smeared / line), abs=5e-3)


@given(width=st.floats(1e-8, 25), distance=st.floats(0.02, 390))
@settings(max_examples=60, deadline=None)
def test_derivatives_of_the_smearing(width: float, distance: float) -> None:
    d = np.array([-distance, distance])
    _, by_width, by_distance = log_smearing(width, d)
    h = 1e-6
    numeric = (log_smearing(width * np.exp(h), d)[0] - log_smearing(width * np.exp(-h), d)[0]) / (
        2 * h
    )
    assert by_width == pytest.approx(numeric, abs=1e-4)
    numeric = (log_smearing(width, d + h)[0] - log_smearing(width, d - h)[0]) / (2 * h)
    # the cubics of neighbours meet with the same slope, but not with the same bend
    assert by_distance == pytest.approx(numeric, rel=1e-3, abs=2e-2)
    assert by_distance[0] == pytest.approx(-by_distance[1])


def test_wide_lines_are_as_they_are() -> None:
    value, _, _ = log_smearing(WIDE, np.linspace(-100, 100, 201))
    assert np.max(np.abs(value)) < 0.02


@pytest.mark.parametrize("frequency", [20.0, 123.4567])
def test_periodogram_of_a_sinusoid_is_the_taper(frequency: float) -> None:
    n, rate, rms = 48_000, 800.0, 100.0
    k = np.arange(n)
    y = rms * np.sqrt(2) * np.cos(2 * np.pi * frequency * k / rate + 0.3)
    data = loop_periodogram(y, None, frame_rate_hz=rate, stretches=[(0, n)])
    assert data.duration_s is not None
    d = (data.frequency_hz - frequency) * data.duration_s
    width = 1e-8
    for low, high in ((0, 1.5), (1.5, 4), (4, 10), (10, 20), (20, 40)):
        inside = (np.abs(d) >= low) & (np.abs(d) < high)
        line = width / np.pi / (width**2 + d[inside] ** 2)
        model = line * np.exp(log_smearing(width, d[inside])[0]) * rms**2 * data.duration_s
        assert np.mean(data.power(1.0)[inside]) == pytest.approx(np.mean(model), rel=0.06)


@pytest.mark.parametrize("width", [1e-3, 0.02, 0.3, 2.0, 12.0])
def test_skirts_are_those_of_the_line_beyond_its_reach(width: float) -> None:
    """In 4096 samples of the taper they were 3 % too high at the end of the table."""
    (reach,) = smearing_reach(np.array([width]))
    beyond = np.linspace(reach, 500, 4000)
    assert np.max(np.abs(log_smearing(width, beyond[beyond < 400])[0]), initial=0) < 0.004
    t, r = correlations()
    d = reach + np.arange(8) + 0.5  # at the middle of lobes, whose mean the table has
    decay = r * np.exp(-2 * np.pi * width * t)
    smeared = [2 * trapezoid(decay * np.sinc(t) * np.cos(2 * np.pi * at * t), t) for at in d]
    line = width / np.pi / (width**2 + d**2)
    aliased = np.sinc(d / (t.size - 1)) ** 2  # of the same sum over samples
    assert np.mean(smeared * aliased / line) == pytest.approx(1, abs=0.05)


def test_wider_lines_reach_less() -> None:
    reach = smearing_reach(np.append(np.geomspace(1e-12, 1.0, 200), [3.0, WIDE]))
    assert np.all(np.diff(reach) <= 0)
    assert reach[0] > 400 > 50 > reach[199] > reach[-1] == 0
