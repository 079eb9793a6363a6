"""Ends of scales, and the texts of their ticks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbt_synth.report.scales import (
    ROOM,
    keep_apart,
    log_tick_texts,
    log_ticks,
    scale_ends,
    shorten,
    spread_labels,
)


@pytest.mark.parametrize(
    ("log", "low", "values", "ends"),
    [
        (False, None, [1.0, 3.0], (1.0, 3.0)),
        (False, 0.0, [1.0, 3.0], (0.0, 3.0)),
        (True, None, [-1.0, 0.0, 0.1, 10.0, np.nan], (0.1, 10.0)),
        (False, None, [5.0], (4.5, 5.5)),
        (False, None, [], (0.9, 1.1)),
        (True, None, [], (np.exp(-0.5), np.exp(0.5))),
        (False, None, [0.0], (-0.5, 0.5)),
        (True, None, [1e-17, 10.0], (1e-7, 10.0)),  # a zero is no scale
    ],
)
def test_ends_of_scales(log, low, values, ends):
    found = scale_ends([np.array(values)], [], log=log, ends=(low, None), room=0.0)
    assert found == pytest.approx(ends)


@pytest.mark.parametrize(
    ("log", "given", "marked", "values", "ends"),
    [
        # room is of what is shown, not of what the values span
        (False, (0.0, None), True, [98.0, 100.0], (0.0, 104.0)),
        # markers on an end that is given, and lines along it, are not cut
        (False, (0.0, None), True, [0.0, 100.0], (-4.0, 104.0)),
        (False, (0.0, 100.0), False, [100.0, 100.0, 50.0], (0.0, 104.0)),
        (False, (0.0, 100.0), False, [0.0, 100.0, 50.0], (0.0, 100.0)),
        (True, (1.0, None), True, [1.0, 100.0], (100**-0.04, 100**1.04)),
        (False, (5.0, None), False, [1.0, 2.0], (5.0, 6.0 + 0.04)),
    ],
)
def test_curves_are_not_cut_by_the_ends_of_their_scale(log, given, marked, values, ends):
    y = np.array(values)
    assert scale_ends([y], [(y, marked)], log=log, ends=given, room=ROOM) == pytest.approx(ends)
    assert scale_ends([y], [], log=log, ends=given, room=ROOM)[0] == pytest.approx(given[0])


def test_ticks():
    assert log_ticks(0.1, 400) == pytest.approx([0.1, 1, 10, 100])
    assert log_ticks(20, 300) == pytest.approx([20, 50, 100, 200])
    assert len(log_ticks(1e-9, 1e9)) < 10
    assert log_ticks(64.0, 171.0) == pytest.approx([80, 100, 120, 140, 160])  # not 100 alone
    for ratio in (1.001, 1.1, 1.9, 3.0, 5.0, 9.9):
        for low in np.geomspace(1, 10, 23):
            ticks = log_ticks(low, ratio * low)
            assert 3 <= len(ticks) <= 9
            assert low * (1 - 1e-9) <= ticks[0] < ticks[-1] <= ratio * low * (1 + 1e-9)
    assert log_tick_texts([1.2e5, 1.25e5]) == ["1.2·10⁵", "1.25·10⁵"]
    assert log_tick_texts([0.001, 0.1, 2, 10_000]) == ["0.001", "0.1", "2", "10000"]
    assert log_tick_texts([1e-6, 1.0, 2e5]) == ["10⁻⁶", "10⁰", "2·10⁵"]
    assert shorten("abcdefghij", 5) == "ab…ij"
    assert shorten("abc", 5) == "abc"


@given(st.lists(st.floats(0, 1), max_size=40))
def test_labels_do_not_overlap(wanted):
    wanted = sorted(wanted)
    places = spread_labels(np.array(wanted), 0.045)
    gap = min(0.045, 1 / max(len(wanted), 1))
    assert places.size == len(wanted)
    assert np.all(np.diff(places) > gap - 1e-9)
    assert np.all((places > 0) & (places < 1))
    if wanted and np.all(np.diff([-0.03, *wanted, 1.03]) > 0.06):
        assert places == pytest.approx(wanted)


def test_of_labels_that_cover_each_other_the_first_stays():
    boxes = [(0, 0, 2, 1), (1, 0, 3, 1), (2.5, 0, 4, 1), (0, 2, 2, 3)]
    assert keep_apart(boxes) == [True, False, True, True]
