"""Spectra of resonances and of a low pass: values and derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid

from lbt_synth.models.resonance_spectrum import (
    coefficient_rows,
    drive_ratio,
    log_roll_off,
    resonance_densities,
    unit_densities,
)

RATE = 1000.0


def log_density(frequency, damping, s):
    """Logarithm of the spectrum of unit variance, and its two derivatives."""
    one = np.ones(1)
    value, slopes = resonance_densities(frequency * one, damping * one, one, s)
    return np.log(value[0]), *slopes[0]


@given(
    frequency=st.floats(0.01, 400), damping=st.floats(1e-4, 20).filter(lambda z: abs(z - 1) > 1e-6)
)
@settings(max_examples=20)
def test_density_is_that_of_the_process_and_its_derivatives_are_right(
    frequency: float, damping: float
) -> None:
    f = np.array([0.02, 0.7, 5.0, 60.0, 333.0, 499.0])
    s = 4 * np.sin(np.pi * f / RATE) ** 2
    w = 2 * np.pi * frequency / RATE
    value, by_frequency, by_damping = log_density(w, damping, s)
    (a1, a2), drive = coefficient_rows(np.array(w), np.array(damping)), drive_ratio(w, damping)
    # the direct formula loses digits to cancellation where b is small
    direct = np.log(drive) - 2 * np.log(
        np.abs(1 - a1 * np.exp(-2j * np.pi * f / RATE) - a2 * np.exp(-4j * np.pi * f / RATE))
    )
    assert value == pytest.approx(direct, abs=1e-15 / w**2 + 1e-8)
    h = 1e-5
    for found, move in ((by_frequency, (h, 0)), (by_damping, (0, h))):
        up, down = (
            log_density(w * np.exp(t * move[0]), damping * np.exp(t * move[1]), s)[0]
            for t in (1, -1)
        )
        numeric = (up - down) / (2 * h)
        assert found == pytest.approx(numeric, abs=1e-5 * (1 + np.max(np.abs(numeric))))


def test_density_has_unit_variance_and_passes_critical_damping_smoothly() -> None:
    f = np.linspace(0, RATE / 2, 400_001)
    s = 4 * np.sin(np.pi * f / RATE) ** 2
    for damping in (0.05, 1 - 1e-9, 1 + 1e-9, 3.0):
        value, *_ = log_density(2 * np.pi * 20 / RATE, damping, s)
        mean = trapezoid(np.exp(value), f) / (RATE / 2)
        assert mean == pytest.approx(1, rel=1e-6)
    around = [log_density(0.1, z, s[1:]) for z in (1 - 1e-9, 1 + 1e-9)]
    for one, other in zip(*around, strict=True):
        assert np.allclose(one, other, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("frequency", "damping", "sections"),
    [(0.25, 0.02, 2), (1.0, 0.3, 4), (2.9, 0.2, 2), (0.02, 0.5, 4)],
)
def test_a_bump_has_unit_variance_and_right_slopes(
    frequency: float, damping: float, sections: int
) -> None:
    w = np.linspace(0, np.pi, 200_001)
    s = 4 * np.sin(w / 2) ** 2
    assert trapezoid(unit_densities([frequency], [damping], s, [sections])[0], w) == pytest.approx(
        np.pi
    )
    h, unit = 1e-5, np.ones(1)
    _, slopes = resonance_densities(frequency * unit, damping * unit, unit, s, [sections])
    for slope, move in zip(slopes[0], ((h, 0), (0, h)), strict=True):
        up, down = (
            np.log(
                unit_densities(
                    [frequency * np.exp(t * move[0])],
                    [damping * np.exp(t * move[1])],
                    s,
                    [sections],
                )[0]
            )
            for t in (1, -1)
        )
        assert np.allclose(slope, (up - down) / (2 * h), rtol=1e-5, atol=1e-4)


def test_roll_off_has_unit_gain_at_zero_and_a_right_derivative() -> None:
    s = np.array([0.0, 1e-4, 0.5, 4.0])
    for corner in (1e-3, 0.2, 3.0):
        value, slope = log_roll_off(corner, 5 / 6, s)
        assert value[0] == 0
        numeric = (
            log_roll_off(corner * np.exp(1e-6), 5 / 6, s)[0]
            - log_roll_off(corner * np.exp(-1e-6), 5 / 6, s)[0]
        ) / 2e-6
        assert slope == pytest.approx(numeric, abs=1e-8)
