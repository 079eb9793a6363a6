"""How figures are drawn: looks, legends, titles, the user's own axes, numbers and files."""

import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.pages import every_mark

import lbt_synth as lbt
from lbt_synth.report.draw import (
    colour,
    dot_style,
    draw_map,
    drawing,
    figure_series,
    line_style,
    name_axes,
    save_figure,
)
from lbt_synth.storage.display_unit import own_display_unit, show_in

X, Y = ("x", ""), ("y", "")
LONG = "a very long name " * 3


def test_different_looks_differ():
    assert len({str(line_style(i)) for i in range(36)}) == 36
    assert len({(colour(i), dot_style(i)["marker"]) for i in range(36)}) == 36
    assert colour(None) not in [colour(i) for i in range(36)]


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_titles_are_whole_and_stay_above_their_panel(columns):
    with drawing([2.0] * columns, columns=columns) as panels:
        for panel in panels:
            name_axes(panel, X, Y, LONG)
            panel.plot([0.0, 1.0], [0.0, 1.0], label="a")
    figure = panels[0].figure
    figure.draw_without_rendering()
    (names,) = figure.legends
    for axes in figure.axes:
        assert axes.get_title(loc="left").split() == LONG.split()
        title = axes._left_title.get_window_extent()
        assert title.x1 <= axes.get_window_extent().x1 + 1
        assert title.y1 <= names.get_window_extent().y0 + 1


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.1, 400, ["0.1", "1", "10", "100"]),
        (20, 300, ["20", "50", "100", "200"]),
        (64, 171, ["80", "100", "120", "140", "160"]),  # not 100 alone
    ],
)
def test_ticks_of_logarithmic_scales(low, high, texts):
    with drawing([2.0]) as (panel,):
        name_axes(panel, X, Y, yscale="log")
        panel.plot([0.0, 1.0, 2.0], [0.0, low, high])
    panel.figure.draw_without_rendering()
    bottom, top = panel.get_ylim()
    ticks = panel.yaxis.get_major_ticks()
    assert [t.label1.get_text() for t in ticks if bottom <= t.get_loc() <= top] == texts


def draw_two(axes=None):
    with drawing([2.0, 2.0], axes=axes) as panels:
        for panel, name in zip(panels, ("first", "second"), strict=True):
            name_axes(panel, ("frequency", "Hz"), Y)
            for middle in "ab":  # shortened alike, they stay two
                panel.plot([0.0, 1.0], label=name + 50 * "x" + middle + 50 * "x")
    return panels[0].figure


def test_a_figure_on_axes_of_the_user():
    axes = Figure().subplots(2, 1)
    assert draw_two(axes) is axes[0].figure
    assert axes[0].get_xlabel() == "frequency [Hz]"
    names = [[text.get_text() for text in one.get_legend().get_texts()] for one in axes]
    assert [[name[:6] for name in both] for both in names] == [["firstx"] * 2, ["second"] * 2]
    assert not axes[0].figure.legends
    assert len(draw_two().legends[0].get_texts()) == 4
    own = Figure()
    with drawing([2.0], axes=own.subplots()) as (panel,):
        draw_map([panel], [(np.arange(2.0), np.arange(2.0), np.eye(2))], "ratio [%]")
    assert own.axes[1].get_xlabel() == "ratio [%]"  # of the colour bar


def test_axes_that_do_not_fit_are_refused():
    for axes, words in (
        (Figure().subplots(), "got 1 (Axes)"),
        (Figure().subplots(3), "got 3 (Axes, Axes, Axes)"),
        ("above", "got 1 (str)"),
        ([], "got 0 (none)"),
    ):
        expected = f"axes must be 2 matplotlib Axes, one per panel; {words}."
        with pytest.raises(lbt.errors.ProblemError, match=f"^{re.escape(expected)}$"):
            draw_two(axes)


def test_numbers_are_those_that_are_drawn_in_the_unit_that_is_shown():
    lines, maps = (list(figure_series(chart.figure)) for chart in every_mark())
    first, steps = (one for one in lines if one.name == "first")
    assert (first.heading, first.panel, steps.panel) == ("frequency [Hz]", "size [-]", "steps [nm]")
    np.testing.assert_allclose(first.x * first.y, 1.0)
    assert {one.name for one in lines} == {"first", "second", "dots"}  # no guides, no empty ones
    assert [one.name for one in maps[:2]] == [f"ratio [%] at gain [-] {x}" for x in (0.2, 0.4)]
    np.testing.assert_array_equal(maps[1].y, np.arange(6.0, 12.0))
    assert maps[0].panel == "first: gain [-]"
    with own_display_unit():
        show_in("mas", 10.0)
        _, other = (s for s in figure_series(every_mark()[0].figure) if s.name == "first")
    assert other.panel == "steps [mas]"
    np.testing.assert_allclose(other.y, steps.y / 10)


def test_figures_are_files(tmp_path):
    for ending, magic in (("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")):
        content = save_figure(draw_two(), tmp_path / f"f.{ending}").read_bytes()
        assert content.startswith(magic)
        assert len(content) < 400_000
