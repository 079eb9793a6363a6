"""A design from a record, and what is noted against it."""

from __future__ import annotations

import numpy as np
import pytest
from support.recorded_loops import LINE, RATE, spliced_record

import lbt_synth as lbt


def test_a_design_is_doubted_where_the_gains_disagree() -> None:
    first = spliced_record((0,), lines=LINE, frames=20_000, sensor_gain=0.9)
    second = spliced_record((1,), lines=LINE, frames=12_000, sensor_gain=0.4)
    both = lbt.identification.loop_record(
        np.vstack([first.measurements[:12_000], second.measurements]),
        np.vstack([first.commands[:12_000], second.commands]),
        frame_rate_hz=RATE,
        delay_frames=2,
        unit="nm",
    )
    try:
        notes = lbt.design_from_record(both).notes
    except lbt.errors.CertificateError as error:
        notes = (str(error),)
    assert any("sensor gain" in note for note in notes)
    given = lbt.design_from_record(first, method="hinf")
    assert (given.notes, given.choice, given.name) == ((), None, "H-infinity filter")


def test_a_design_needs_a_delay_and_data():
    noise = np.random.default_rng(0).standard_normal((9000, 1))
    with pytest.raises(
        lbt.errors.ProblemError, match="delay of this loop is not known; give delay_frames"
    ):
        lbt.design_from_record(
            lbt.identification.loop_record(noise, noise, frame_rate_hz=RATE, unit="nm")
        )
    with pytest.raises(lbt.errors.ProblemError, match="LoopRecord"):
        lbt.design_from_record(noise)
    short = lbt.identification.loop_record(
        noise[:900], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    with pytest.raises(
        lbt.errors.ProblemError, match=r"needs 8000 usable frames \(8 s at 1000 Hz\).*got 900 \(0.9"
    ):
        lbt.design_from_record(short)
    with pytest.raises(lbt.errors.ProblemError, match="method"):
        lbt.design_from_record(short, method="magic")
