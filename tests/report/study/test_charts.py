"""The charts of a study show its numbers, and do not grow with its samples."""

import json

import numpy as np
import pytest
from support.study_pages import CONTROLLERS, page_of, results

from lbt_synth.report.charts.bokeh_charts import embed_charts
from lbt_synth.report.study.charts import distribution_chart, loss_chart
from lbt_synth.studies.study.statistics import read_controller_samples


def test_the_size_does_not_grow_with_the_samples():
    small, large = (
        len(json.dumps(embed_charts(page_of(results(n)).charts)[0])) for n in (4000, 200_000)
    )
    assert small < large < 1.4 * small
    assert large < 1e6


def test_charts_show_the_numbers_of_the_columns():
    columns = results()
    found = [read_controller_samples(columns, name) for name in CONTROLLERS]
    curves = {c.name: c for c in distribution_chart(found)[0].panels[0].marks if hasattr(c, "x")}
    sharp = found[1].strehl
    assert curves["sharp"].y[1] == pytest.approx(100 * np.mean(sharp == 0))
    loss = {c.name: c for c in loss_chart(found)[0].panels[0].marks}
    whole = found[2].evaluated
    best = np.max([each.strehl[whole] for each in found], axis=0)
    at = np.searchsorted(loss["sharp"].x, 10, side="right") - 1
    expected = 100 * np.mean(100 * (best - sharp[whole]) > loss["sharp"].x[at] + 1e-9)
    assert loss["sharp"].y[at] == pytest.approx(expected)
