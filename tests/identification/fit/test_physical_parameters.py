"""Tests of whiteness: how often they refuse white noise, and what they see."""

from __future__ import annotations

import numpy as np
from support.recorded_loops import integrator_loop

import lbt_synth as lbt
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.physical_parameters import whiteness

RATE = 1000.0


FRAMES = 16_384


def test_what_is_left_out_is_not_white() -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),))
    found = lbt.identification.identify_axis(
        y[:, 0], c[:, 0], frame_rate_hz=RATE, sensor_gain=0.6, most_lines=0
    )
    assert not found.lines
    assert not found.whiteness.white
    assert found.whiteness.p_value < 1e-6


def test_whiteness_of_white_noise_in_segments() -> None:
    rng = np.random.default_rng(0)
    for pieces in ([(0, 8192)], [(i * 1024, (i + 1) * 1024) for i in range(4)]):
        p_values = []
        for _ in range(120):
            white = rng.standard_normal(8192)
            data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=pieces)
            model = np.full(data.frequency_hz.size, 2 / RATE)
            test = whiteness(data, data.power(1.0), model)
            p_values.append((test.p_value, test.correlation_p_value))
        # 120 trials: at most 6 below 1 %, and 16 below 5 %, with a probability of 0.999
        assert np.all(np.sum(np.array(p_values) < 0.01, axis=0) <= 6)
        assert np.all(np.sum(np.array(p_values) < 0.05, axis=0) <= 16)
