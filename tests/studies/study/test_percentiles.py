"""Percentiles and shares against scipy."""

import numpy as np
import pytest
from scipy import stats
from support.study_results import draw_points

from lbt_synth.studies.study.percentiles import percentiles, share


@pytest.mark.parametrize("n", [1, 7, 200])
def test_percentiles_are_numpys_and_intervals_are_scipys(n):
    values = np.random.default_rng(n).normal(size=n)
    for each in percentiles(values, (0, 1, 5, 50, 95, 99, 100)):
        assert each.value == pytest.approx(np.percentile(values, each.percent))
        if 0 < each.percent < 100:
            test = stats.quantile_test(values, q=0, p=each.percent / 100)
            expected = test.confidence_interval(0.95)
            np.testing.assert_allclose([each.low, each.high], [expected.low, expected.high])


@pytest.mark.parametrize("kind", ["independent", "latin", "sobol"])
def test_intervals_hold_the_true_percentile(kind):
    """Of a smooth function of three parameters; even samples are the better ones."""
    reference = np.sort(draw_points("sobol", 2**18, 3, seed=99) @ np.array([1, 0.5, 0.2]))
    true = {p: np.percentile(reference, p) for p in (5, 50)}
    held = {5: 0, 50: 0}
    for seed in range(150):
        values = draw_points(kind, 256, 3, seed) @ np.array([1, 0.5, 0.2])
        for each in percentiles(values, (5, 50)):
            held[int(each.percent)] += each.low <= true[int(each.percent)] <= each.high
    assert min(held.values()) >= (136 if kind == "independent" else 146)


def test_percentiles_of_residuals_that_are_infinite():
    values = np.array([1.0, 2.0, 3.0, np.inf, np.inf])
    found = percentiles(values, (0, 50, 60, 75, 100))
    assert [each.value for each in found] == [1, 3, np.inf, np.inf, np.inf]


@pytest.mark.parametrize(("count", "total"), [(0, 50), (50, 50), (3, 50), (40, 4000)])
def test_intervals_of_parts_are_scipys(count, total):
    found = share(np.arange(total) < count)
    expected = stats.binomtest(count, total).proportion_ci(0.95, method="exact")
    np.testing.assert_allclose([found.low, found.high], [expected.low, expected.high], rtol=1e-9)
    assert found.value == count / total
