"""Fits of given components: what leaves the band is dropped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.identification.fit.fitting import Search, fit
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.whittle import SpectrumModel

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
