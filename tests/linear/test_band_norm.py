"""Norms over a band of frequencies."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear.norms import band_norm


def test_norms_over_a_band():
    lag = lbt.linear.StateSpace(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]], dt_s=0.01)
    assert band_norm(lag, 0.0, 50.0).value == pytest.approx(lbt.hinf_norm(lag).value, rel=1e-12)
    edge = abs(1 / (np.exp(2j * np.pi * 0.1) - 0.5))
    assert band_norm(lag, 10.0, 50.0).value == pytest.approx(edge, rel=1e-12)
    line = lbt.linear.StateSpace(A=[[1.9, -0.99], [1, 0]], B=[[1.0], [0]], C=[[1.0, 0]], D=[[0.0]])
    whole = lbt.hinf_norm(line)
    f = whole.peak_frequency_hz
    assert band_norm(line, f / 2, 2 * f).value == pytest.approx(whole.value, rel=1e-10)
    below = band_norm(line, 0.0, f / 2)
    assert below.value == pytest.approx(
        float(lbt.linear.largest_singular_values(line, [f / 2])[0]), rel=1e-10
    )
