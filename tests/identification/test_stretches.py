"""Stretches of a record: halves to fit and to test on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lbt_synth as lbt


@given(
    st.lists(st.integers(1, 50), min_size=2, max_size=12),
    st.integers(0, 30),
    st.floats(0.05, 0.95),
)
def test_halves_are_apart_and_in_order(lengths, gap, share):
    ends = np.cumsum(lengths)
    stretches = [(int(a), int(b)) for a, b in zip(ends[::2], ends[1::2], strict=False)]
    frames = int(ends[-1])
    usable = np.zeros(frames, dtype=bool)
    for a, b in stretches:
        usable[a:b] = True
    arguments = {"gap_frames": gap, "fit_share": share}
    first = np.flatnonzero(usable)[: int(share * usable.sum())]
    # nothing to fit, or everything after the fit lies in the gap
    if first.size == 0 or not usable[first[-1] + 1 + gap :].any():
        with pytest.raises(
            lbt.errors.ProblemError, match="must leave frames to fit and to test on"
        ):
            lbt.identification.split_halves(stretches, frames, **arguments)
        return
    fit, test = lbt.identification.split_halves(stretches, frames, **arguments)
    fitted, tested = np.zeros((2, frames), dtype=bool)
    for mask, parts in ((fitted, fit), (tested, test)):
        for a, b in parts:
            assert a < b
            assert not mask[a:b].any()
            mask[a:b] = True
    assert not np.any(~usable & (fitted | tested))
    np.testing.assert_array_equal(np.flatnonzero(fitted), first)
    last = first[-1]
    np.testing.assert_array_equal(
        np.flatnonzero(tested), np.flatnonzero(usable[last + 1 + gap :]) + last + 1 + gap
    )


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


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"gap_frames": -1}, "gap_frames must be at least 0"),
        ({"gap_frames": 30}, "must leave frames to fit and to test on"),
        ({"fit_share": 0.0}, "fit_share must be above 0"),
        ({"fit_share": 1.0}, "fit_share must be below 1"),
    ],
)
def test_halves_that_are_refused(more, message):
    with pytest.raises(lbt.errors.ProblemError, match=message):
        lbt.identification.split_halves(None, 40, **more)
