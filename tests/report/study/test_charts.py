"""The charts of a study show its numbers, and do not grow with its samples."""

import json

import numpy as np
import pytest
from support.study_pages import CONTROLLERS, page_of, results

from lbt_synth.report.charts.bokeh_charts import embed_charts
from lbt_synth.report.study.charts import (
    binned_map,
    cumulative_points,
    distribution_chart,
    histogram,
    loss_chart,
)
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


@pytest.mark.parametrize("n", [1, 5, 400, 401, 50_000])
def test_points_of_a_distribution_lie_on_it(n):
    values = np.round(np.random.default_rng(n).normal(size=n), 2)
    level, part = cumulative_points(values)
    assert len(level) <= 500
    assert np.all(np.diff(level) > 0)
    expected = [np.mean(values <= each) for each in level]
    np.testing.assert_allclose(part, expected)
    assert part[-1] == 1
    assert level[0] == values.min()


def test_a_histogram_has_every_sample():
    values = np.random.default_rng(0).normal(size=1000)
    edges, part = histogram(values)
    assert part.sum() == pytest.approx(1)
    assert len(edges) == len(part) + 1


def test_a_map_has_the_mean_of_each_cell():
    rng = np.random.default_rng(1)
    x, y = rng.random(4000), rng.choice([1.0, 2.0, 5.0], 4000)
    result = x * y
    columns, rows, mean = binned_map(x, y, result)
    np.testing.assert_array_equal(rows, [1, 2, 5])
    inner = slice(1, -1)  # the outermost cells hold what is beyond
    np.testing.assert_allclose(mean[:, inner], np.outer(rows, columns)[:, inner], atol=0.05)
    edges = np.concatenate(([-np.inf], (columns[:-1] + columns[1:]) / 2, [np.inf]))
    first = (y == 2) & (x < edges[1])
    assert mean[1, 0] == pytest.approx(result[first].mean())
    sparse = binned_map(np.arange(9.0), np.arange(9.0), np.arange(9.0))[2]
    assert np.isnan(sparse).any()  # a cell without samples
