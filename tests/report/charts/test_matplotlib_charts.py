"""Charts for paper: their text, and titles that fit."""

import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.pages import every_mark, many_panels

import lbt_synth as lbt
from lbt_synth.report.charts.description import Area, Axis, Curve, Panel
from lbt_synth.report.charts.matplotlib_charts import chart_svg, draw_figure


def texts_of(svg):
    return re.findall(r"<text[^>]*>(.*?)</text>", svg)


def test_drawings_keep_their_text():
    svg = chart_svg(every_mark()[0])
    words = texts_of(svg)
    for word in ("frequency [Hz]", "size [-]", "steps [nm]", "first", "second", "only named"):
        assert word in words
    assert svg == chart_svg(every_mark()[0])
    assert 'viewBox="0 0' in svg
    assert " width=" not in svg.split(">")[0]
    strange = chart_svg(every_mark("$\\frac{$ 文字")[0])  # no mathematics, and no such glyph
    assert "$\\frac{$ 文字" in texts_of(strange)


def test_titles_of_panels_stay_in_their_drawing():
    title = "a very long name " * 10
    for columns in (1, 2, 3):
        figure = draw_figure(many_panels(columns, title, columns).panels, columns=columns)
        figure.draw_without_rendering()
        for axes in figure.axes:
            shown = axes.get_title(loc="left")
            assert "…" in shown
            ends = axes._left_title.get_window_extent()
            assert ends.x1 <= axes.get_window_extent().x1 + 1


def test_areas_and_errors_end_at_the_edges_of_their_panel():
    """Programs that draw an SVG need not cut them off there."""
    x = np.array([1.0, 2.0, 3.0])
    area = Area(name="", x=x, low=x * 1e-9, high=x)
    curve = Curve(name="", x=x, y=x, error=2 * x)
    panel = Panel(x=Axis(label="x"), y=Axis(label="y", low=0.1, high=2.5), marks=(area, curve))
    (axes,) = draw_figure([panel]).axes
    assert axes.get_ylim() == (0.1, 2.5)
    for drawn in axes.collections:
        heights = np.concatenate([path.vertices[:, 1] for path in drawn.get_paths()])
        assert heights.min() == 0.1
        assert heights.max() == 2.5


def test_a_figure_on_axes_of_the_user():
    figure = Figure()
    axes = figure.subplots(2, 1)
    lines, maps, _ = every_mark()
    assert draw_figure(lines.panels, axes=axes) is figure
    assert figure.axes == list(axes)
    assert axes[0].get_xlabel() == "frequency [Hz]"
    legends = [[text.get_text() for text in own.get_legend().get_texts()] for own in axes]
    assert legends[0][:4] == ["band", "spread", "line at 20 Hz", "first"]
    assert legends[1] == ["range", "level", "first"]
    assert not figure.legends
    own = Figure()
    pair = own.subplots(1, 2)
    draw_figure(maps.panels, axes=pair)
    assert len(own.axes) == 3  # and the colour bar
    assert own.axes[2].get_ylabel() == "ratio [%]"
    single = Figure().subplots()
    assert draw_figure(lines.panels[:1], axes=single) is single.figure


def test_axes_that_do_not_fit_are_refused():
    panels = every_mark()[0].panels
    for axes, words in (
        (Figure().subplots(), "got 1 (Axes)"),
        (Figure().subplots(3), "got 3 (Axes, Axes, Axes)"),
        ("above", "got 1 (str)"),
        ([1, 2], "got 2 (int, int)"),
        ([], "got 0 (none)"),
    ):
        expected = f"axes must be 2 matplotlib Axes, one per panel; {words}."
        with pytest.raises(lbt.errors.ProblemError, match=f"^{re.escape(expected)}$"):
            draw_figure(panels, axes=axes)


def test_flags_and_error_bars_are_drawn():
    above = draw_figure(every_mark()[0].panels).axes[0]
    assert [text.get_text() for text in above.texts] == ["first", "flag"]
    first, second = (text.get_position()[0] for text in above.texts)
    assert 0 < first < second < 1
    (bars,) = [found for found in above.collections if hasattr(found, "get_segments")]
    low, high = bars.get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((5.0, 15.0))
