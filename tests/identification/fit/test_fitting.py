"""Fits of given components: what leaves the band, or adds too little, is dropped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lbt_synth.identification.fit.fitting import Search, fit, prune, required_gain
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.spectrum_model import SpectrumModel
from lbt_synth.identification.fit.whittle import contrast

RATE = 1000.0


def test_a_line_that_leaves_the_band_is_dropped() -> None:
    white = np.random.default_rng(0).standard_normal(8192)
    data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=[(0, white.size)])
    search = Search(data=data, gain=1.0)
    slow = search.component("turbulence", 1.0, 0.5, 0.1)
    line = search.component("line", 100.0, 0.01, 1e-4)
    start = SpectrumModel(0.0, 0.0, 0.0, search.log_angle(50.0), (slow, line))
    inside = fit(search, start)
    assert inside is not None
    assert len(inside.spectrum.components) == 2
    away = replace(line, log_frequency=search.log_angle(1e-9), log_power=-30.0)
    found = fit(search, replace(start, components=(slow, away)))
    assert found is not None
    assert len(found.spectrum.components) == 1


@pytest.mark.parametrize("damping", [0.08, 0.5])
def test_a_line_in_the_skirts_of_a_wide_resonance_costs_as_much_as_any_other(
    damping: float,
) -> None:
    """Only the place of a line close to another narrow one need not be searched for."""
    white = np.random.default_rng(0).standard_normal(8192)
    data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=[(0, white.size)])
    search = Search(data=data, gain=1.0)
    slow = search.component("turbulence", 1.0, 0.5, 0.1)
    line = search.component("line", 100.0, 0.01, 0.1)
    wide = search.component("line", 90.0, damping, 1.0)
    start = SpectrumModel(0.0, 0.0, 0.0, search.log_angle(50.0), (slow, line))
    assert required_gain(search, start.add(wide), 1) == search.price
    assert required_gain(search, start.add(wide), 2) == search.price
    close = search.component("line", 102.0, 0.01, 0.1)
    assert required_gain(search, start.add(close), 1) < search.price


def test_a_wide_component_in_the_place_of_the_noise_becomes_noise() -> None:
    """A resonance near the Nyquist frequency, damped within a frame, is white as noise is."""
    rng = np.random.default_rng(2)
    walk = np.cumsum(rng.standard_normal(32768))
    series = 26 * rng.standard_normal(walk.size) + walk - np.linspace(0, walk[-1], walk.size)
    data = loop_periodogram(series, None, frame_rate_hz=RATE, stretches=[(0, walk.size)])
    search = Search(data=data, gain=1.0)
    slow = search.component("turbulence", 0.3, 0.5, 50.0**2)
    wide = search.component("line", 450.0, 0.826, 26.0**2)
    start = SpectrumModel(0.0, float(np.log(0.3**2)), 0.0, search.log_angle(50.0), (slow, wide))
    found = fit(search, start)
    assert found is not None
    stuck = replace(found, spectrum=start, contrast=contrast(data, start))
    pruned = prune(search, stuck).spectrum
    assert pruned.lines == ()
    assert np.exp(pruned.log_noise) == pytest.approx(26**2, rel=0.05)
