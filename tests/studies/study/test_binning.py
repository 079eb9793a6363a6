"""Samples in bins: distributions, histograms and maps."""

import numpy as np
import pytest

from lbt_synth.studies.study.binning import binned_map, cumulative_points, histogram


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
    found = binned_map(x, y, result)
    np.testing.assert_array_equal(found.y, [1, 2, 5])
    assert found.samples.sum() == 4000
    inner = slice(1, -1)  # the outermost cells hold what is beyond
    np.testing.assert_allclose(
        found.mean[:, inner], np.outer(found.y, found.x)[:, inner], atol=0.05
    )
    np.testing.assert_allclose(np.nansum(found.mean * found.samples), result.sum())
