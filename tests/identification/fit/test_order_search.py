"""The gain at which a fit begins, and searches that rounding does not move."""

from __future__ import annotations

import pytest
from support.recorded_loops import hidden_resonance_record, integrator_loop

import lbt_synth as lbt

RATE = 1000.0


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


def test_rounding_does_not_move_the_search() -> None:
    """It moved this one by 15 in the log-likelihood, and its gain from 0.76 to 0.93."""
    record = hidden_resonance_record(3)
    y, c = record.measurements[:, 0], record.corrections()[:, 0]
    one, other = (
        lbt.identification.identify_axis(
            y * scale, c * scale, frame_rate_hz=RATE, stretches=record.stretches()
        )
        for scale in (1.0, 1.0 + 2e-12)
    )
    assert len(one.parts) == len(other.parts)
    assert one.fitted_model.contrast == pytest.approx(other.fitted_model.contrast, abs=0.5)
    assert one.sensor_gain == pytest.approx(other.sensor_gain, rel=0.01)
