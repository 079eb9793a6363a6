"""Sensitivities of controllers to parameters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from support.study_results import draw_points, make_columns

import lbt_synth as lbt
from lbt_synth.studies.study.summary import (
    varying_parameters,
)


@pytest.mark.parametrize("weights", [(1.0, 2.0, 3.0), (5.0, 0.1, 1.0)])
def test_an_additive_model_has_the_shares_of_its_terms(weights):
    u = draw_points("sobol", 4096, 3, seed=1)
    columns = make_columns({f"p{i}": u[:, i] for i in range(3)}, {"a": u @ np.array(weights) / 10})
    found = lbt.studies.study_statistics(columns, ["p0", "p1", "p2"], ["a"]).sensitivities[0]
    expected = np.square(weights) / np.sum(np.square(weights))
    np.testing.assert_allclose([p.index.value for p in found.parameters], expected, atol=2e-3)
    assert found.interactions == pytest.approx(0, abs=3e-3)
    # uniform parameters: the mean of 14 of 16 groups runs over 14/16 less one group of the range
    np.testing.assert_allclose(
        [p.swing for p in found.parameters], np.array(weights) / 10 * 13 / 16, rtol=0.02
    )


def test_what_only_two_together_do_is_in_no_index():
    u = draw_points("independent", 5000, 2, seed=4)
    result = (u[:, 0] - 0.5) * (u[:, 1] - 0.5) + 0.5
    columns = make_columns({"p": u[:, 0], "q": u[:, 1]}, {"a": result})
    found = lbt.studies.study_statistics(columns, ["p", "q"], ["a"]).sensitivities[0]
    for each in found.parameters:
        assert abs(each.index.value) < 4 * each.index.error
        assert each.index.value < 0.02
    assert found.interactions > 0.97


def test_constants_have_no_index():
    u = draw_points("independent", 200, 1, seed=0)
    columns = make_columns(
        {"p": u[:, 0], "fixed": np.full(200, 0.9)}, {"a": u[:, 0], "b": 0 * u[:, 0]}
    )
    found = lbt.studies.study_statistics(columns, ["p", "fixed"], ["a", "b"])
    varying, fixed = found.sensitivities[0].parameters
    assert varying.index.value == pytest.approx(1, abs=1e-3)
    assert np.isnan(fixed.index.value)
    assert np.isnan(fixed.spearman)
    assert fixed.curve is None
    flat = found.sensitivities[1]
    assert flat.ranked == ()
    assert np.isnan(flat.sum)
    assert np.isnan(flat.parameters[0].index.value)
    assert varying_parameters(found) == ("p",)


@pytest.mark.parametrize("ties", [False, True])
def test_rank_correlation_is_scipys(ties):
    rng = np.random.default_rng(3)
    p = rng.normal(size=500)
    strehl = 1 / (1 + np.exp(-2 * p + rng.normal(size=500)))
    if ties:
        p, strehl = np.round(p, 1), np.round(strehl, 1)
    columns = make_columns({"p": p}, {"a": strehl})
    found = lbt.studies.study_statistics(columns, ["p"], ["a"]).sensitivities[0].parameters[0]
    assert found.spearman == pytest.approx(stats.spearmanr(p, strehl).statistic, abs=1e-12)
