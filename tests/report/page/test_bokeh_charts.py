"""Charts for the screen: their data, and the same scales as on paper."""

from __future__ import annotations

import json

import pytest
from matplotlib.figure import Figure
from support.pages import every_mark

from lbt_synth.report.page.bokeh_charts import embed_charts
from lbt_synth.report.page.charts import Axis, Chart, Curve, Panel, legend_entries
from lbt_synth.report.page.matplotlib_charts import chart_height, draw_chart


def test_the_data_of_charts_are_those_given():
    chart = every_mark()[0]
    drawn = embed_charts([chart])
    numbers = json.dumps(drawn.embedding)
    assert set(drawn.lines["lines"]) == set(legend_entries(chart.panels)) - {"only named"}
    for identifiers in drawn.lines["lines"].values():
        for identifier in identifiers:
            assert numbers.count(f'"{identifier}"') >= 1
    assert len(drawn.lines["lines"]["first"]) == 2  # once a panel
    assert drawn.places == {"lines": ("lines_panel-1", "lines_panel-2")}
    assert '"x": "p' not in numbers


def test_both_renderers_leave_the_same_room():
    curve = Curve(name="a", x=[0.0, 1.0, 2.0], y=[0.0, 99.0, 100.0], marker="own")
    panel = Panel(x=Axis(label="x"), y=Axis(label="y", low=0.0), marks=(curve,))
    chart = Chart(key="room", title="t", caption="c", alt="a", panels=(panel,))
    data = embed_charts([chart]).embedding["documents"]["page"]["roots"][0]["attributes"]
    ends = data["y_range"]["attributes"]
    assert (ends["start"], ends["end"]) == pytest.approx((-4.0, 104.0))
    figure = Figure(figsize=(7, chart_height(chart)))
    draw_chart(figure, chart, left=0, top=chart_height(chart))
    assert figure.axes[0].get_ylim() == pytest.approx((-4.0, 104.0))
