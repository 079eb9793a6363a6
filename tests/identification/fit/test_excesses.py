"""Bands with too much power."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.identification.fit.excesses import find_candidates
from lbt_synth.identification.fit.periodogram import loop_periodogram

RATE = 1000.0


def test_scan_finds_a_line_and_nothing_in_noise() -> None:
    rng = np.random.default_rng(3)
    n = 20_000
    noise = rng.standard_normal(n)
    flat = np.full(9999, 2 / RATE)
    for amplitude, count in ((0.0, 0), (0.3, 1)):
        y = noise + amplitude * np.sin(2 * np.pi * 77.7 * np.arange(n) / RATE)
        data = loop_periodogram(y, None, frame_rate_hz=RATE, stretches=[(0, n)])
        found = find_candidates(
            data, data.power(1.0), flat[: data.frequency_hz.size], least=14.0, most=5
        )
        assert len(found) == count
        if count:
            assert found[0].frequency_hz == pytest.approx(77.7, abs=0.1)
