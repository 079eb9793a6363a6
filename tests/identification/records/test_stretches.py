"""Frames of a record: halves and later parts, to fit and to test on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbt_synth.errors import ProblemError
from lbt_synth.identification import loop_record
from lbt_synth.identification.records.record import LoopRecord, cut_stretches, split_halves


def frames_in(stretches):
    return np.concatenate([np.arange(start, stop) for start, stop in stretches])


def record_with(good) -> LoopRecord:
    good = np.array(good)
    y = np.ones((len(good), 1))
    return LoopRecord(frame_rate_hz=500, measurements=y, measured=good, commanded=good | True)


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_halves_are_apart_and_in_order(good):
    record = record_with(good)
    if sum(good) < 2:
        with pytest.raises(ProblemError, match=f"to fit and to test on; got {sum(good)} usable"):
            split_halves(record)
        return
    fit, test = (frames_in(half.stretches()) for half in split_halves(record))
    assert len(fit) == sum(good) // 2
    np.testing.assert_array_equal(np.concatenate([fit, test]), np.flatnonzero(good))


def test_a_half_keeps_what_was_bridged_and_its_commands():
    y = np.random.default_rng(0).standard_normal((2000, 1))
    y[[300, 1500]] = np.nan
    record = loop_record(y, y, frame_rate_hz=500, delay_frames=2, unit="nm").bridged()
    first, later = split_halves(record)
    assert first.usable[300]
    assert later.usable[1500]
    np.testing.assert_array_equal(first.usable | later.usable, record.usable)
    np.testing.assert_array_equal(later.corrections(), record.corrections())


def test_cuts_are_those_of_the_usable_frames():
    usable = ((10, 400), (450, 460), (500, 1001))
    everything = frames_in(usable)
    for first, last in ((0, 390), (389, 401), (395, 901)):
        part = cut_stretches(usable, first, last)
        assert np.array_equal(frames_in(part), everything[first:last])
