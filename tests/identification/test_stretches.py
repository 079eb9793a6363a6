"""Stretches of a record: halves and later parts, to fit and to test on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lbt_synth as lbt
from lbt_synth.identification.stretches import forward_splits


def frames_in(stretches):
    return np.concatenate([np.arange(start, stop) for start, stop in stretches])


@given(st.lists(st.integers(1, 50), min_size=2, max_size=12), st.floats(0.05, 0.95))
def test_halves_are_apart_and_in_order(lengths, share):
    ends = np.cumsum(lengths)
    stretches = [(int(a), int(b)) for a, b in zip(ends[::2], ends[1::2], strict=False)]
    usable = frames_in(stretches)
    if int(share * len(usable)) == 0:
        with pytest.raises(lbt.errors.ProblemError, match="frames to train on and to test on"):
            lbt.identification.split_halves(stretches, int(ends[-1]), fit_share=share)
        return
    fit, test = lbt.identification.split_halves(stretches, int(ends[-1]), fit_share=share)
    assert len(frames_in(fit)) == int(share * len(usable))
    np.testing.assert_array_equal(np.concatenate([frames_in(fit), frames_in(test)]), usable)


def test_tests_cover_the_rest_once_and_follow_their_training():
    usable = [(10, 400), (450, 460), (500, 1001)]
    pairs = forward_splits(usable, 1200, splits=4, first_share=0.4)
    everything = frames_in(usable)
    assert len(pairs) == 4
    for training, test in pairs:
        both = np.concatenate([frames_in(training), frames_in(test)])
        assert np.array_equal(both, everything[: len(both)])
    tests = np.concatenate([frames_in(test) for _, test in pairs])
    assert np.array_equal(tests, everything[-len(tests) :])
    assert len(tests) == pytest.approx(0.6 * len(everything), abs=1)
    lengths = [len(frames_in(test)) for _, test in pairs]
    assert max(lengths) - min(lengths) <= 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"splits": 0}, "splits"),
        ({"first_share": 1.0}, "first_share"),
        ({"splits": 7}, "10 usable frames for 7 splits"),
    ],
)
def test_splits_that_a_record_cannot_have(options, words):
    with pytest.raises(lbt.errors.ProblemError, match=words):
        forward_splits([(0, 10)], 10, **options)


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
    ],
)
def test_stretches_that_are_refused(arguments, message):
    with pytest.raises(lbt.errors.ProblemError, match=message):
        lbt.identification.split_halves(*arguments)
