"""Charts for paper: their text, and titles that fit."""

from __future__ import annotations

import re

from matplotlib.figure import Figure
from support.pages import every_mark, many_panels

from lbt_synth.report.page.matplotlib_charts import chart_style, chart_svg, draw_chart


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
        figure = Figure(figsize=(7, 12))
        with chart_style():
            draw_chart(figure, many_panels(columns, title, columns), left=0, top=12)
            figure.canvas.draw()
            for axes in figure.axes:
                shown = axes.get_title(loc="left")
                assert "…" in shown
                ends = axes._left_title.get_window_extent()
                assert ends.x1 <= axes.get_window_extent().x1 + 1
