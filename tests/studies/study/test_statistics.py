"""Statistics of studies and their tables: percentiles, shares, indices."""

import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc

from lbt_synth.storage.display_unit import own_display_unit, show_in
from lbt_synth.studies.study.statistics import (
    first_order_index,
    percentiles,
    share,
    study_statistics,
    summary_tables,
    worst_table,
)

NAN = float("nan")
RESULTS = ("stable", "strehl", "residual_nm")


def make_columns(parameters, strehls, **changes):
    """Columns of results in which every loop is stable, unless changed."""
    columns = parameters | {"row": np.arange(len(next(iter(parameters.values()))))}
    for name, strehl in strehls.items():
        columns |= {f"{name}.strehl": strehl, f"{name}.stable": np.ones(len(strehl))}
        columns[f"{name}.residual_nm"] = np.full(len(strehl), 100.0)
    return columns | changes


def cell_text(cell):
    return cell if isinstance(cell, str) else cell.text


def test_unstable_counts_as_zero_and_failed_is_left_out(small):
    found = study_statistics(small, ["gain"], ["a", "b"])
    a, b = found.controllers
    assert (a.samples, a.failed, a.unstable, a.unstable_share.value) == (4, 1, 1, 0.25)
    assert (b.samples, b.failed, b.unstable, b.unstable_share.value) == (5, 0, 2, 0.4)
    assert a.mean == pytest.approx((0.8 + 0 + 0.4 + 0.6) / 4)
    assert a.mean_error == pytest.approx(np.std([0.8, 0, 0.4, 0.6], ddof=1) / 2)
    assert a.strehl[50].value == pytest.approx(0.5)
    assert a.residual_nm[50].value == pytest.approx(80)
    assert a.residual_nm[99].value == np.inf
    assert (a.worst, b.worst) == ((1, 2, 4, 0), (1, 2, 3, 4, 0))


@pytest.mark.parametrize("n", [1, 7, 200])
def test_intervals_of_percentiles_hold_so_many_order_statistics(n):
    values = np.random.default_rng(n).normal(size=n)
    ordered = np.sort(values)
    for percent, each in percentiles(values, (1, 5, 50, 95, 99)).items():
        assert each.value == pytest.approx(np.percentile(values, percent))
        # at most 2.5 % of samples have so many values below, or above, the true percentile
        first, last = (np.searchsorted(ordered, end) for end in (each.low, each.high))
        part = percent / 100
        assert np.isnan(each.low) or stats.binom.cdf(first, n, part) <= 0.025
        assert np.isnan(each.high) or stats.binom.sf(last, n, part) <= 0.025


def test_percentiles_of_residuals_that_are_infinite():
    values = np.array([1.0, 2.0, 3.0, np.inf, np.inf])
    found = percentiles(values, (1, 50, 60, 75, 99))
    assert [each.value for each in found.values()] == [1.04, 3, np.inf, np.inf, np.inf]


@pytest.mark.parametrize(("count", "total"), [(0, 50), (50, 50), (3, 50), (40, 4000)])
def test_intervals_of_parts_are_those_of_clopper_and_pearson(count, total):
    found = share(np.arange(total) < count)
    assert found.value == count / total
    # each tail beyond the ends has 2.5 %
    assert count == 0 or stats.binom.sf(count - 1, total, found.low) == pytest.approx(0.025)
    assert count == total or stats.binom.cdf(count, total, found.high) == pytest.approx(0.025)


def ishigami(u, a=7.0, b=0.1):
    x = np.pi * (2 * u - 1)
    return np.sin(x[:, 0]) + a * np.sin(x[:, 1]) ** 2 + b * x[:, 2] ** 4 * np.sin(x[:, 0])


def ishigami_indices(a=7.0, b=0.1):
    """T. Ishigami and T. Homma, Proc. ISUMA 1990, 398: the variances are integrals of powers."""
    first = (1 + b * np.pi**4 / 5) ** 2 / 2
    second = a**2 / 8
    first_and_third = b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    return np.array([first, second, 0.0, 0.0]) / (first + second + first_and_third)


def test_indices_are_those_of_ishigami_and_of_salib():
    u = qmc.Sobol(4, seed=5).random(4096)
    found = [first_order_index(column, ishigami(u)) for column in u.T]
    values, errors = np.transpose(found)
    np.testing.assert_allclose(values, ishigami_indices(), atol=0.006)
    assert np.all(np.abs(values - ishigami_indices()) < 4 * errors)
    u = np.random.default_rng(5).random((4000, 4))
    values = [first_order_index(column, ishigami(u))[0] for column in u.T]
    np.testing.assert_allclose(values, SALIB, atol=0.0025)


# rbd_fast.analyze of SALib 1.6.0, of the same 4000 samples
SALIB = (0.318278, 0.448807, -0.000789, -0.001446)


@pytest.mark.study
def test_standard_errors_are_those_of_repeated_samples():
    """Mean error, spread over 200 samples, and the mean of the standard errors."""
    n = 1000
    values, errors = np.empty((200, 4)), np.empty((200, 4))
    for seed in range(200):
        u = np.random.default_rng(seed).random((n, 4))
        found = [first_order_index(column, ishigami(u)) for column in u.T]
        values[seed], errors[seed] = np.transpose(found)
    spread = values.std(axis=0)
    ratio = errors.mean(axis=0) / spread
    assert np.all(ratio[:2] > 0.9)
    assert np.all(ratio[:2] < 1.25)
    assert np.all(ratio[2:] > 1)  # of no effect: on the safe side
    assert np.all(ratio[2:] < 2)
    bias = values.mean(axis=0) - ishigami_indices()
    assert np.all(np.abs(bias) < 0.8 * errors.mean(axis=0))


def test_the_index_of_a_list_is_epsilon_squared():
    """Kelley's estimator, from scipy's analysis of variance."""
    rng = np.random.default_rng(1)
    values = rng.integers(0, 4, 400).astype(float)
    result = values**2 + rng.normal(scale=5, size=400)
    f = stats.f_oneway(*(result[values == v] for v in range(4))).statistic
    between, within = 3, 400 - 4
    epsilon = between * (f - 1) / (between * f + within)
    assert first_order_index(values, result)[0] == pytest.approx(epsilon, rel=1e-9)


def test_constants_have_no_index():
    u = np.random.default_rng(0).random((200, 1))
    columns = make_columns(
        {"p": u[:, 0], "fixed": np.full(200, 0.9)}, {"a": u[:, 0], "b": 0 * u[:, 0]}
    )
    found = study_statistics(columns, ["p", "fixed"], ["a", "b"])
    first, flat = found.controllers
    assert first.sensitivity["p"]["index"] == pytest.approx(1, abs=1e-3)
    assert np.isnan([*first.sensitivity["fixed"].values()]).all()
    assert flat.ranked == ()
    assert np.isnan(flat.sensitivity["p"]["index"])
    assert found.ranked == ("p",)
    table = next(t for t in summary_tables(found) if t.caption.startswith("Variance"))
    assert [row[2] for row in table.rows if len(row) > 1] == ["-", "-"]


def test_one_odd_sample_makes_no_index():
    """One unstable loop of 1000 gave a parameter without effect an index of 0.8."""
    rng, order = np.random.default_rng(0), np.arange(1000.0)
    quiet = 0.82 + 0.005 * rng.normal(size=1000)
    for place in rng.integers(0, 1000, 20):
        result = np.where(order == place, 0.0, quiet)
        assert abs(first_order_index(order, result)[0]) < 0.05


def test_the_order_of_tied_samples_makes_no_index():
    """A grid of 64 x 64 gave the parameter without effect 0.32."""
    one, other = (axis.ravel() for axis in np.meshgrid(np.arange(64.0), np.arange(64.0)))
    columns = make_columns({"a": other, "b": one}, {"k": one / 64})
    rows = study_statistics(columns, ["a", "b"], ["k"]).controllers[0].sensitivity
    assert abs(rows["a"]["index"]) < 0.01
    assert rows["b"]["index"] == pytest.approx(1, abs=0.01)


def test_a_controller_that_always_failed_has_dashes_and_no_numbers():
    columns = make_columns({"p": np.linspace(0, 1, 50)}, {"a": np.linspace(0, 1, 50)})
    columns |= {"b.stable": np.full(50, NAN), "b.strehl": np.full(50, NAN)}
    columns["b.residual_nm"] = np.full(50, NAN)
    found = study_statistics(columns, ["p"], ["a", "b"])
    failed = found.controllers[1]
    assert (failed.samples, failed.failed, failed.worst) == (0, 50, ())
    first = summary_tables(found)[0]
    column = {row[0]: cell_text(row[2]) for row in first.rows if len(row) > 1}
    assert (column.pop("evaluated"), column.pop("failed")) == ("0", "50")
    assert set(column.values()) == {"-"}


def test_tables(small):
    found = study_statistics(small, ["gain"], ["a", "b"])
    tables = {table.caption.split(" over")[0]: table for table in summary_tables(found)}
    assert len(tables) == 2  # too few samples for indices
    strehl = {
        cell_text(row[0]): cell_text(row[1]) for row in tables["Strehl ratio"].rows if len(row) > 1
    }
    assert strehl["mean ± standard error"] == "45.00 ± 17.08"
    assert strehl["50th percentile"] == "50.0"
    assert strehl["unstable, counted as 0 [%]"].startswith("25.00 (0.63 to 80.59")
    assert (strehl["evaluated"], strehl["failed"]) == ("4", "1")
    residual = {row[0]: row[1] for row in tables["Residual of tip and tilt"].rows if len(row) > 1}
    assert residual["99th percentile"] == "unstable"
    assert residual["50th percentile"] == "80.0"
    with own_display_unit():
        show_in("mas", 8.0)
        angles = summary_tables(found)[1]
    assert angles.headings[0] == "residual [mas rms]"
    assert {row[0]: row[1] for row in angles.rows if len(row) > 1}["50th percentile"] == "10.00"
    worst = worst_table(found.controllers[0], small, ["gain"])
    assert [cell_text(cell) for cell in worst.rows[0]] == ["11", "unstable", "0.6"]
    assert [cell_text(cell) for cell in worst.rows[1]] == ["12", "40.0", "0.7"]
