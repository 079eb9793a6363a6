"""Stretches of a record: halves and later parts, to fit and to test on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification.stretches import cut_stretches


def frames_in(stretches):
    return np.concatenate([np.arange(start, stop) for start, stop in stretches])


@given(st.lists(st.integers(1, 50), min_size=2, max_size=12), st.floats(0.05, 0.95))
def test_halves_are_apart_and_in_order(lengths, share):
    ends = np.cumsum(lengths)
    stretches = [(int(a), int(b)) for a, b in zip(ends[::2], ends[1::2], strict=False)]
    usable = frames_in(stretches)
    if int(share * len(usable)) == 0:
        with pytest.raises(ProblemError, match="frames to fit and to test on"):
            lbt.identification.split_halves(stretches, int(ends[-1]), fit_share=share)
        return
    fit, test = lbt.identification.split_halves(stretches, int(ends[-1]), fit_share=share)
    assert len(frames_in(fit)) == int(share * len(usable))
    np.testing.assert_array_equal(np.concatenate([frames_in(fit), frames_in(test)]), usable)


def test_cuts_are_those_of_the_usable_frames():
    usable = ((10, 400), (450, 460), (500, 1001))
    everything = frames_in(usable)
    for first, last in ((0, 390), (389, 401), (395, 901)):
        part = cut_stretches(usable, first, last)
        assert np.array_equal(frames_in(part), everything[first:last])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([(0, 20), (10, 30)], 40), "in order, apart"),
        (([(0, 50)], 40), "within 40 frames"),
        (([(5, 5)], 40), "not empty"),
        (([(-1, 5)], 40), "at least 0"),
        (([(0.0, 5)], 40), "must be an integer"),
        (([7], 40), "a pair \\(start, stop\\)"),
        (([], 40), "at least one stretch"),
        ((None, 0), "frames must be at least 1"),
        (([(0, 1)], 1), "frames to fit and to test on; got 1 usable"),
    ],
)
def test_stretches_that_are_refused(arguments, message):
    with pytest.raises(ProblemError, match=message):
        lbt.identification.split_halves(*arguments)
