"""Jumps in a record: found, noted, and cut out."""

from __future__ import annotations

import numpy as np
import pytest
from support.recorded_loops import LINE, spliced_record

import lbt_synth as lbt
from lbt_synth.identification.fit.jumps import cut_around


def test_a_jump_is_found_noted_and_cut() -> None:
    clean = lbt.identify(spliced_record(lines=LINE, frames=20_000))
    spliced = spliced_record((0, 1), lines=LINE, frames=20_000)
    found = lbt.identify(spliced)
    assert not clean.notes
    assert all(note.startswith("warning: 1 jump of the") for note in found.notes)
    assert "the record was cut there" in found.notes[0]
    axis = found.axes[0]
    assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
    assert axis.noise_nm == pytest.approx(6, abs=4 * axis.noise_error_nm)


def test_frames_that_were_lost_do_not_move_the_gain() -> None:
    whole = spliced_record((3,), lines=LINE, frames=20_000)
    y, u = (
        np.vstack([series[:2000], series[9000:]]) for series in (whole.measurements, whole.commands)
    )
    spliced = lbt.identification.loop_record(y, u, frame_rate_hz=1000, delay_frames=2, unit="nm")
    found = lbt.identify(spliced)
    axis = found.axes[0]
    assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
    assert axis.sensor_gain_error < 0.05
    assert any("jump" in note for note in found.notes)


def test_stretches_are_cut() -> None:
    assert cut_around(((0, 100), (200, 300)), [50, 200]) == ((0, 47), (53, 100), (203, 300))
    assert cut_around(((0, 4),), [1]) == ()
