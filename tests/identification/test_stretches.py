"""Stretches of a record: halves and later parts, to fit and to test on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbt_synth.errors import ProblemError
from lbt_synth.identification.stretches import checked_stretches, cut_stretches, split_halves


def frames_in(stretches):
    return np.concatenate([np.arange(start, stop) for start, stop in stretches])


@given(st.lists(st.integers(1, 50), min_size=4, max_size=12))
def test_halves_are_apart_and_in_order(lengths):
    ends = np.cumsum(lengths)
    stretches = [(int(a), int(b)) for a, b in zip(ends[::2], ends[1::2], strict=False)]
    usable = frames_in(stretches)
    fit, test = split_halves(stretches)
    assert len(frames_in(fit)) == len(usable) // 2
    np.testing.assert_array_equal(np.concatenate([frames_in(fit), frames_in(test)]), usable)


def test_a_frame_alone_has_no_halves():
    with pytest.raises(ProblemError, match="frames to fit and to test on; got 1 usable"):
        split_halves(((0, 1),))


def test_cuts_are_those_of_the_usable_frames():
    usable = ((10, 400), (450, 460), (500, 1001))
    everything = frames_in(usable)
    for first, last in ((0, 390), (389, 401), (395, 901)):
        part = cut_stretches(usable, first, last)
        assert np.array_equal(frames_in(part), everything[first:last])


@pytest.mark.parametrize(
    ("stretches", "message"),
    [
        ([(0, 20), (10, 30)], "in order, apart"),
        ([(0, 50)], "within 40 frames"),
        ([(5, 5)], "not empty"),
        ([(-1, 5)], "at least 0"),
        ([(0.0, 5)], "must be an integer"),
        ([7], "a pair \\(start, stop\\)"),
        ([], "at least one stretch"),
    ],
)
def test_stretches_that_are_refused(stretches, message):
    with pytest.raises(ProblemError, match=message):
        checked_stretches(stretches, 40)
