"""Bands with too much power, and the gain at which a fit begins."""

from __future__ import annotations

import numpy as np
import pytest
from support.recorded_loops import integrator_loop

import lbt_synth as lbt
from lbt_synth.identification.fit.order_search import find_candidates
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


def test_lines_that_are_still_missing_do_not_carry_the_gain_away() -> None:
    lines = ((39.7, 0.01, 4.1), (135.3, 0.004, 5.0), (109.0, 0.01, 14.9))
    y, c = integrator_loop(
        lines=lines, noise=2.9, sensor_gain=1.15, gain=0.2, frames=30_000, seed=30
    )
    found = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    assert found.sensor_gain_error is not None
    assert found.sensor_gain == pytest.approx(1.15, abs=3 * found.sensor_gain_error)
    assert [line.frequency_hz for line in found.lines] == pytest.approx(
        sorted(f for f, _, _ in lines), abs=0.3
    )
    assert found.whiteness.white
