"""Ends of scales, and the texts of their ticks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbt_synth.report.charts.description import Area, Axis, Curve, Panel, Rule, Span
from lbt_synth.report.charts.scales import (
    keep_apart,
    legend_entries,
    log_tick_texts,
    log_ticks,
    scale_ends,
    shorten,
    spread_labels,
)


@pytest.mark.parametrize(
    ("axis", "values", "ends"),
    [
        (Axis(label="x"), [1.0, 3.0], (1.0, 3.0)),
        (Axis(label="x", low=0.0), [1.0, 3.0], (0.0, 3.0)),
        (Axis(label="x", log=True), [-1.0, 0.0, 0.1, 10.0, np.nan], (0.1, 10.0)),
        (Axis(label="x"), [5.0], (4.5, 5.5)),
        (Axis(label="x"), [], (0.9, 1.1)),
        (Axis(label="x", log=True), [], (np.exp(-0.5), np.exp(0.5))),
        (Axis(label="x"), [0.0], (-0.5, 0.5)),
        (Axis(label="x", log=True), [1e-17, 10.0], (1e-7, 10.0)),  # a zero is no scale
    ],
)
def test_ends_of_scales(axis, values, ends):
    curve = Curve(name="a", x=values, y=np.ones(len(values)))
    found, _ = scale_ends(Panel(x=axis, y=Axis(label="y"), marks=(curve,)))
    assert found == pytest.approx(ends)


@pytest.mark.parametrize(
    ("axis", "marker", "values", "ends"),
    [
        # room is of what is shown, not of what the values span
        (Axis(label="y", unit="%", low=0.0), "own", [98.0, 100.0], (0.0, 104.0)),
        # markers on an end that is given, and lines along it, are not cut
        (Axis(label="y", unit="%", low=0.0), "own", [0.0, 100.0], (-4.0, 104.0)),
        (Axis(label="y", low=0.0, high=100.0), None, [100.0, 100.0, 50.0], (0.0, 104.0)),
        (Axis(label="y", low=0.0, high=100.0), None, [0.0, 100.0, 50.0], (0.0, 100.0)),
        (Axis(label="y", log=True, low=1.0), "own", [1.0, 100.0], (100**-0.04, 100**1.04)),
        (Axis(label="y", low=5.0), None, [1.0, 2.0], (5.0, 6.0 + 0.04)),
    ],
)
def test_curves_are_not_cut_by_the_ends_of_their_scale(axis, marker, values, ends):
    curve = Curve(name="a", x=np.arange(len(values)), y=values, marker=marker)
    panel = Panel(x=Axis(label="x"), y=axis, marks=(curve,))
    _, found = scale_ends(panel)
    assert found == pytest.approx(ends)
    shaded = Area(name="b", x=curve.x, low=curve.y, high=curve.y)
    standing = scale_ends(Panel(x=Axis(label="x"), y=axis, marks=(curve, shaded)))[1]
    assert standing[0] == pytest.approx(axis.low)


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


def test_a_legend_names_what_is_seen():
    x = np.array([1.0, 3.0])
    marks = (
        Curve(name="curve", x=x, y=x),
        Curve(name="far above", x=x, y=x + 50),
        Curve(name="unstable", x=np.zeros(0), y=np.zeros(0)),
        Rule(name="line", at=2.0),
        Rule(name="line beyond", at=20.0),
        Rule(name="level", at=9.0, axis="y"),
        Span(name="band at the edge", low=2.9, high=40.0),
        Span(name="band beyond", low=30.0, high=40.0),
    )
    panel = Panel(x=Axis(label="x"), y=Axis(label="y", low=0.0, high=10.0), marks=marks)
    seen = ["curve", "unstable", "line", "level", "band at the edge"]
    assert list(legend_entries([panel])) == seen
    beside = Panel(x=Axis(label="x", high=50.0), y=panel.y, marks=marks)
    assert set(legend_entries([panel, beside])) == {*seen, "line beyond", "band beyond"}
