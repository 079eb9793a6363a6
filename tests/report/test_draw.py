"""How figures are drawn: looks, legends, titles, the user's own axes, numbers and files."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from support.pages import every_mark

import lbt_synth as lbt
from lbt_synth.report.draw import (
    colour,
    dashes,
    drawing,
    figure_series,
    marker_of,
    save_figure,
    spread_labels,
)
from lbt_synth.storage.display_unit import own_display_unit, show_in

X, Y = {"label": "x"}, {"label": "y"}
LONG = "a very long name " * 3


def test_different_looks_differ():
    assert len({(colour(i), dashes(i)) for i in range(36)}) == 36
    assert len({(colour(i), marker_of(i)) for i in range(36)}) == 36
    assert colour(None) not in [colour(i) for i in range(36)]


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_titles_are_whole_and_stay_above_their_panel(columns):
    with drawing([2.0] * columns, columns=columns) as panels:
        for panel in panels:
            panel.set_axes(X, Y, title=LONG)
            panel.curve("a", [0.0, 1.0], [0.0, 1.0])
    figure = panels[0].figure
    figure.draw_without_rendering()
    (names,) = figure.legends
    for axes in figure.axes:
        assert axes.get_title(loc="left").split() == LONG.split()
        title = axes._left_title.get_window_extent()
        assert title.x1 <= axes.get_window_extent().x1 + 1
        assert title.y1 <= names.get_window_extent().y0 + 1


def test_bars_are_in_view_from_the_top():
    axes = every_mark()[2].figure.axes[0]
    low, high = axes.get_ylim()
    places = [bar.get_y() + bar.get_height() / 2 for bar in axes.patches]
    assert low > max(places) > min(places) > high
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a.b", "first", "c"]


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.1, 400, ["0.1", "1", "10", "100"]),
        (20, 300, ["20", "50", "100", "200"]),
        (64, 171, ["80", "100", "120", "140", "160"]),  # not 100 alone
        (1e-9, 10.0, ["1e\u221206", "0.0001", "0.01", "1"]),  # a zero is no scale
    ],
)
def test_ticks_of_logarithmic_scales(low, high, texts):
    with drawing([2.0]) as (panel,):
        panel.set_axes(X, {"label": "y", "log": True})
        panel.curve("curve", [0.0, 1.0, 2.0], [0.0, low, high])
    panel.figure.draw_without_rendering()
    bottom, top = panel.axes.get_ylim()
    ticks = panel.axes.yaxis.get_major_ticks()
    shown = [tick.label1.get_text() for tick in ticks if bottom <= tick.get_loc() <= top]
    assert shown == texts
    assert bottom >= 0.999e-8 * top


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


def test_names_that_are_shortened_alike_stay_two():
    with drawing([2.0]) as (panel,):
        for middle in "ab":
            panel.curve(50 * "x" + middle + 50 * "x", [0.0, 1.0], [0.0, 1.0])
    assert len(panel.figure.legends[0].get_texts()) == 2


def draw_two(axes=None):
    with drawing([2.0, 2.0], axes=axes) as panels:
        for panel, name in zip(panels, ("_first", "second"), strict=True):
            panel.set_axes({"label": "frequency", "unit": "Hz"}, Y)
            panel.curve(name, [0.0, 1.0], [0.0, 1.0])
    return panels[0].figure


def test_a_figure_on_axes_of_the_user():
    axes = Figure().subplots(2, 1)
    assert draw_two(axes) is axes[0].figure
    assert axes[0].get_xlabel() == "frequency [Hz]"
    names = [[text.get_text() for text in one.get_legend().get_texts()] for one in axes]
    assert names == [[" _first"], ["second"]]
    assert not axes[0].figure.legends
    own = Figure()
    with drawing([2.0], axes=own.subplots()) as (panel,):
        panel.set_axes(X, Y)
        panel.map(np.arange(2.0), np.arange(2.0), np.eye(2), "ratio", "%")
    assert own.axes[1].get_ylabel() == "ratio [%]"  # of the colour bar


def test_axes_that_do_not_fit_are_refused():
    for axes, words in (
        (Figure().subplots(), "got 1 (Axes)"),
        (Figure().subplots(3), "got 3 (Axes, Axes, Axes)"),
        ("above", "got 1 (str)"),
        ([1, 2], "got 2 (int, int)"),
        ([], "got 0 (none)"),
    ):
        expected = f"axes must be 2 matplotlib Axes, one per panel; {words}."
        with pytest.raises(lbt.errors.ProblemError, match=f"^{re.escape(expected)}$"):
            draw_two(axes)


def test_flags_and_error_bars_are_drawn():
    above = every_mark()[0].figure.axes[0]
    assert [text.get_text() for text in above.texts] == ["first", "flag"]
    first, second = (text.get_position()[0] for text in above.texts)
    assert 0 < first < second < 1
    (bars,) = [found for found in above.collections if hasattr(found, "get_segments")]
    low, high = bars.get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((5.0, 15.0))


def test_circles_are_round_and_labels_beside_them():
    with drawing([2.5] * 4, columns=2) as panels:
        for panel in panels:
            axis = {"label": "part", "low": -1.0, "high": 1.0}
            panel.set_axes(axis, axis, title="title", equal=True)
            panel.curve("circle", [1.0, 0.0], [0.0, 1.0])
    panels[0].figure.draw_without_rendering()
    for axes in panels[0].figure.axes:
        box = axes.get_window_extent()
        assert box.width == pytest.approx(box.height, rel=1e-6)
        assert box.width > 2 * panels[0].figure.dpi
    above, below = (panels[i].axes for i in (0, 2))
    assert above.xaxis.label.get_window_extent().y0 > below._left_title.get_window_extent().y1


def test_numbers_are_those_that_are_drawn_in_the_unit_that_is_shown():
    lines, maps, rest = (figure_series(chart.figure) for chart in every_mark())
    first, steps = (one for one in lines if one.name == "first")
    assert (first.heading, first.panel, steps.panel) == ("frequency [Hz]", "size [-]", "steps [nm]")
    np.testing.assert_allclose(first.x * first.y, 1.0)
    assert "only named" not in {one.name for one in lines}
    assert [one.name for one in maps[:2]] == ["ratio at gain [-] 0.2", "ratio at gain [-] 0.4"]
    np.testing.assert_array_equal(maps[1].y, np.arange(6.0, 12.0))
    bars = {one.name: (one.x, list(one.y)) for one in rest}
    assert bars["first order share [%]"] == (("a.b", "first", "c"), [1, 2, 3])
    with own_display_unit():
        show_in("mas", 10.0)
        figure = every_mark()[0].figure
    (_, other) = (one for one in figure_series(figure) if one.name == "first")
    assert other.panel == "steps [mas]"
    np.testing.assert_allclose(other.y, steps.y / 10)
    assert figure.axes[1].get_ylabel() == "steps [mas]"


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_figures_are_files(tmp_path, ending):
    path = save_figure(draw_two(), tmp_path / f"f.{ending}")
    magic = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[ending]
    assert path.read_bytes().startswith(magic)
    assert path.stat().st_size < 400_000
