"""First-order indices where chance, lists, ties and units may mislead them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

import lbt_synth as lbt
from lbt_synth.studies import first_order_index


def test_one_odd_sample_is_no_edge() -> None:
    """One unstable loop of 1000 gave a parameter without effect an index of 0.8."""
    rng = np.random.default_rng(0)
    quiet = 0.82 + 0.005 * rng.normal(size=1000)
    found = []
    for place in rng.integers(0, 1000, 60):
        result = quiet.copy()
        result[place] = 0.0
        found.append(first_order_index(np.arange(1000.0), result).value)
    assert np.max(np.abs(found)) < 0.05


@pytest.mark.parametrize("n", [256, 1024])
@pytest.mark.parametrize("values", [10, 32])
def test_an_even_list_without_effect_has_no_index(n: int, values: int) -> None:
    """With the correction of independent samples it was -0.13 of 256 with 32 values."""
    found = []
    for seed in range(20):
        points = qmc.Sobol(2, rng=seed).random(n)
        of_list = np.floor(values * points[:, 0])
        order = np.argsort(of_list, kind="stable")
        found.append(first_order_index(of_list[order], points[order, 1]).value)
    assert abs(np.mean(found)) < 0.01


def test_a_list_of_independent_samples_keeps_its_correction() -> None:
    rng = np.random.default_rng(1)
    found = [
        first_order_index(np.sort(rng.integers(0, 10, 1024) * 1.0), rng.normal(size=1024)).value
        for _ in range(100)
    ]
    assert abs(np.mean(found)) < 0.003


@pytest.mark.parametrize("shuffled", [False, True])
def test_the_order_of_tied_samples_makes_no_index(shuffled: bool) -> None:
    """A grid of 64 x 64 gave the parameter without effect 0.32."""
    one, other = (each.ravel() for each in np.meshgrid(np.arange(64.0), np.arange(64.0)))
    order = np.random.default_rng(1).permutation(4096) if shuffled else np.arange(4096)
    columns = {
        "a": other[order],
        "b": one[order],
        "k.strehl": one[order] / 64,
        "k.stable": np.ones(4096),
        "k.residual_nm": np.ones(4096),
    }
    (found,) = lbt.studies.study_statistics(columns, ["a", "b"], ["k"]).sensitivities
    assert abs(found.find("a").index.value) < 0.01
    assert found.find("b").index.value == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("scale", [1e-300, 1e-170, 1.0, 1e300])
def test_the_index_knows_no_scale(scale: float) -> None:
    x = np.linspace(0, 1, 100)
    assert first_order_index(x, scale * x).value == pytest.approx(1)


def test_a_result_that_is_not_finite_is_refused() -> None:
    x = np.linspace(0, 1, 100)
    with pytest.raises(lbt.errors.ProblemError, match="result must be finite"):
        first_order_index(x, np.where(x > 0.5, np.nan, x))


def test_a_value_that_one_sample_has_makes_no_swing() -> None:
    rng = np.random.default_rng(0)
    x = np.append(rng.choice([10.0, 20.0], 4095), 30.0)
    columns = {
        "x": x,
        "a.strehl": np.append(0.5 + 0.1 * rng.random(4095), 0.9),
        "a.stable": np.ones(4096),
        "a.residual_nm": np.ones(4096),
    }
    (found,) = lbt.studies.study_statistics(columns, ["x"], ["a"]).sensitivities
    assert found.find("x").swing < 0.01
    assert np.isfinite(found.find("x").swing_error)
