"""Statistics of studies against closed forms, published indices and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.stats import qmc

import lbt_synth as lbt
from lbt_synth.studies.study.conditional_curve import conditional_curve
from lbt_synth.studies.study.percentiles import percentiles, share
from lbt_synth.studies.study.summary import (
    comparison_table,
    sensitivity_table,
    varying_parameters,
    worst_table,
)

NAN = float("nan")


def draw(kind, n, dimensions, seed):
    if kind == "independent":
        return np.random.default_rng(seed).random((n, dimensions))
    engine = qmc.Sobol if kind == "sobol" else qmc.LatinHypercube
    return engine(dimensions, rng=seed).random(n)


def index(parameter, result):
    order = np.argsort(parameter, kind="stable")
    return lbt.studies.first_order_index(parameter[order], result[order])


def study(parameters, strehls, **changes):
    """Columns of results in which every loop is stable, unless changed."""
    columns = dict(parameters)
    for name, strehl in strehls.items():
        n = len(strehl)
        columns |= {
            f"{name}.strehl": strehl,
            f"{name}.stable": np.ones(n),
            f"{name}.residual_nm": np.full(n, 100.0),
        }
    return columns | changes


# --------------------------------------------------------------------------
# Indices of first order
# --------------------------------------------------------------------------
def ishigami(u, a=7.0, b=0.1):
    x = np.pi * (2 * u - 1)
    return np.sin(x[:, 0]) + a * np.sin(x[:, 1]) ** 2 + b * x[:, 2] ** 4 * np.sin(x[:, 0])


def ishigami_indices(a=7.0, b=0.1):
    """T. Ishigami and T. Homma, Proc. ISUMA 1990, 398: the variances are integrals of powers."""
    first = (1 + b * np.pi**4 / 5) ** 2 / 2
    second = a**2 / 8
    first_and_third = b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    return np.array([first, second, 0.0, 0.0]) / (first + second + first_and_third)


def test_the_oracle_has_the_published_indices():
    np.testing.assert_allclose(ishigami_indices()[:3], [0.3139, 0.4424, 0], atol=5e-5)


@pytest.mark.parametrize(
    ("kind", "n", "limit"),
    [
        ("independent", 1000, 0.06),
        ("independent", 20_000, 0.015),
        ("latin", 4000, 0.03),
        ("sobol", 1024, 0.02),
        ("sobol", 4096, 0.006),
        ("sobol", 2**16, 0.001),
    ],
)
def test_ishigami(kind, n, limit):
    u = draw(kind, n, 4, seed=5)
    found = [index(column, ishigami(u)) for column in u.T]
    np.testing.assert_allclose([each.value for each in found], ishigami_indices(), atol=limit)
    for each, expected in zip(found, ishigami_indices(), strict=True):
        assert abs(each.value - expected) < 4 * each.error


def test_standard_errors_are_those_of_repeated_samples():
    """Mean error, spread over 200 samples, and the mean of the standard errors."""
    n = 1000
    values, errors = np.empty((200, 4)), np.empty((200, 4))
    for seed in range(200):
        u = draw("independent", n, 4, seed)
        found = [index(column, ishigami(u)) for column in u.T]
        values[seed] = [each.value for each in found]
        errors[seed] = [each.error for each in found]
    spread = values.std(axis=0)
    ratio = errors.mean(axis=0) / spread
    assert np.all(ratio[:2] > 0.9)
    assert np.all(ratio[:2] < 1.25)
    assert np.all(ratio[2:] > 1)  # of no effect: on the safe side
    assert np.all(ratio[2:] < 2)
    bias = values.mean(axis=0) - ishigami_indices()
    assert np.all(np.abs(bias) < 0.8 * errors.mean(axis=0))


def test_even_samples_are_not_corrected_as_if_they_were_independent():
    u = draw("sobol", 4096, 3, seed=3)
    independent = draw("independent", 4096, 3, seed=3)
    even, other = index(u[:, 2], ishigami(u)), index(independent[:, 2], ishigami(independent))
    assert even.correction < 0.1 * other.correction
    assert abs(even.value) < 1e-3


@pytest.mark.parametrize("weights", [(1.0, 2.0, 3.0), (5.0, 0.1, 1.0)])
def test_an_additive_model_has_the_shares_of_its_terms(weights):
    u = draw("sobol", 4096, 3, seed=1)
    columns = study({f"p{i}": u[:, i] for i in range(3)}, {"a": u @ np.array(weights) / 10})
    found = lbt.studies.study_statistics(columns, ["p0", "p1", "p2"], ["a"]).sensitivities[0]
    expected = np.square(weights) / np.sum(np.square(weights))
    np.testing.assert_allclose([p.index.value for p in found.parameters], expected, atol=2e-3)
    assert found.interactions == pytest.approx(0, abs=3e-3)
    # uniform parameters: the mean of 14 of 16 groups runs over 14/16 less one group of the range
    np.testing.assert_allclose(
        [p.swing for p in found.parameters], np.array(weights) / 10 * 13 / 16, rtol=0.02
    )


def test_a_parameter_without_effect_has_no_index():
    u = draw("independent", 3000, 2, seed=2)
    found = index(u[:, 1], np.sin(7 * u[:, 0]))
    assert abs(found.value) < 2.5 * found.error
    assert found.error < 0.01


def test_what_only_two_together_do_is_in_no_index():
    u = draw("independent", 5000, 2, seed=4)
    result = (u[:, 0] - 0.5) * (u[:, 1] - 0.5) + 0.5
    columns = study({"p": u[:, 0], "q": u[:, 1]}, {"a": result})
    found = lbt.studies.study_statistics(columns, ["p", "q"], ["a"]).sensitivities[0]
    for each in found.parameters:
        assert abs(each.index.value) < 4 * each.index.error
        assert each.index.value < 0.02
    assert found.interactions > 0.97


def test_a_list_has_its_values_as_groups():
    rng = np.random.default_rng(0)
    values = rng.choice([10.0, 20.0, 30.0], size=6000, p=[0.5, 0.3, 0.2])
    means = {10.0: 0.2, 20.0: 0.8, 30.0: 0.5}
    exact = np.array([means[v] for v in values])
    result = exact + rng.normal(scale=0.1, size=values.size)
    found = index(values, result)
    mean = 0.5 * 0.2 + 0.3 * 0.8 + 0.2 * 0.5
    between = 0.5 * (0.2 - mean) ** 2 + 0.3 * (0.8 - mean) ** 2 + 0.2 * (0.5 - mean) ** 2
    assert found.groups == 3
    assert found.value == pytest.approx(between / (between + 0.01), abs=4 * found.error)
    ordered = np.argsort(values, kind="stable")
    curve = conditional_curve(values[ordered], exact[ordered], exact[ordered] < 0)
    np.testing.assert_array_equal(curve.parameter, [10, 20, 30])
    np.testing.assert_allclose(curve.mean, [0.2, 0.8, 0.5])
    assert curve.discrete
    assert curve.swing()[0] == pytest.approx(0.6)


def test_the_index_of_a_list_is_epsilon_squared():
    """Kelley's estimator, from scipy's analysis of variance."""
    rng = np.random.default_rng(1)
    values = rng.integers(0, 4, 400).astype(float)
    result = values**2 + rng.normal(scale=5, size=400)
    f = stats.f_oneway(*(result[values == v] for v in range(4))).statistic
    between, within = 3, 400 - 4
    epsilon = between * (f - 1) / (between * f + within)
    assert index(values, result).value == pytest.approx(epsilon, rel=1e-9)


def test_constants_have_no_index():
    u = draw("independent", 200, 1, seed=0)
    columns = study({"p": u[:, 0], "fixed": np.full(200, 0.9)}, {"a": u[:, 0], "b": 0 * u[:, 0]})
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


@given(
    shift=st.floats(-5, 5),
    scale=st.sampled_from([-3.0, 0.01, 7.0]),
    seed=st.integers(0, 1000),
)
def test_the_index_knows_no_units(shift, scale, seed):
    u = draw("independent", 150, 2, seed)
    result = u[:, 0] ** 2 + 0.3 * u[:, 1]
    here = index(u[:, 0], result)
    there = index(np.exp(3 * u[:, 0]), shift + scale * result)
    assert there.value == pytest.approx(here.value, abs=1e-9)
    assert there.error == pytest.approx(here.error, abs=1e-9)


@pytest.mark.parametrize("ties", [False, True])
def test_rank_correlation_is_scipys(ties):
    rng = np.random.default_rng(3)
    p = rng.normal(size=500)
    strehl = 1 / (1 + np.exp(-2 * p + rng.normal(size=500)))
    if ties:
        p, strehl = np.round(p, 1), np.round(strehl, 1)
    columns = study({"p": p}, {"a": strehl})
    found = lbt.studies.study_statistics(columns, ["p"], ["a"]).sensitivities[0].parameters[0]
    assert found.spearman == pytest.approx(stats.spearmanr(p, strehl).statistic, abs=1e-12)


# --------------------------------------------------------------------------
# Percentiles and parts
# --------------------------------------------------------------------------
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
    reference = np.sort(draw("sobol", 2**18, 3, seed=99) @ np.array([1, 0.5, 0.2]))
    true = {p: np.percentile(reference, p) for p in (5, 50)}
    held = {5: 0, 50: 0}
    for seed in range(150):
        values = draw(kind, 256, 3, seed) @ np.array([1, 0.5, 0.2])
        for each in percentiles(values, (5, 50)):
            held[int(each.percent)] += each.low <= true[int(each.percent)] <= each.high
    assert min(held.values()) >= (136 if kind == "independent" else 146)


def test_percentiles_of_residuals_that_are_infinite():
    values = np.array([1.0, 2.0, 3.0, np.inf, np.inf])
    found = percentiles(values, (0, 50, 60, 75, 100))
    assert [each.value for each in found] == [1, 3, np.inf, np.inf, np.inf]


@pytest.mark.parametrize(("count", "total"), [(0, 50), (50, 50), (3, 50), (40, 4000)])
def test_intervals_of_parts_are_scipys(count, total):
    found = share(count, total)
    expected = stats.binomtest(count, total).proportion_ci(0.95, method="exact")
    np.testing.assert_allclose([found.low, found.high], [expected.low, expected.high], rtol=1e-9)
    assert found.value == count / total


# --------------------------------------------------------------------------
# The whole
# --------------------------------------------------------------------------
@pytest.fixture
def small():
    """Five samples, two controllers: unstable loops and a failure."""
    return {
        "row": np.array([10, 11, 12, 13, 14]),
        "gain": np.array([0.5, 0.6, 0.7, 0.8, 0.9]),
        "a.stable": np.array([1, 0, 1, NAN, 1]),
        "a.strehl": np.array([0.8, NAN, 0.4, NAN, 0.6]),
        "a.residual_nm": np.array([50, NAN, 90, NAN, 70]),
        "a.noise_nm": np.array([10, NAN, 30, NAN, 20]),
        "b.stable": np.array([1, 0, 0, 1, 1]),
        "b.strehl": np.array([0.7, NAN, NAN, 0.5, 0.6]),
        "b.residual_nm": np.array([60, NAN, NAN, 80, 70]),
    }


def test_unstable_counts_as_zero_and_failed_is_left_out(small):
    found = lbt.studies.study_statistics(small, ["gain"], ["a", "b"], levels=[0.5])
    a, b = found.controllers
    assert (a.samples, a.failed, a.unstable.count) == (4, 1, 1)
    assert (b.samples, b.failed, b.unstable.count) == (5, 0, 2)
    assert a.mean == pytest.approx((0.8 + 0 + 0.4 + 0.6) / 4)
    assert a.mean_error == pytest.approx(np.std([0.8, 0, 0.4, 0.6], ddof=1) / 2)
    assert a.strehl[3].value == pytest.approx(0.5)
    assert a.above[0.5].count == 2
    assert b.above[0.5].count == 2  # 0.5 is not above 0.5
    assert a.residual_nm[3].value == pytest.approx(80)
    assert a.residual_nm[-1].value == np.inf
    assert a.parts_nm == {"noise": 20.0}
    assert b.parts_nm == {}


def test_comparison_is_of_the_samples_on_which_neither_failed(small):
    pair = lbt.studies.study_statistics(small, ["gain"], ["a", "b"]).comparisons[0]
    assert (pair.first, pair.second) == ("a", "b")
    assert pair.better.total == 4
    assert pair.better.count == 2  # rows 10 and 12
    assert pair.equal.count == 2  # both unstable in row 11, the same in row 14
    assert pair.mean == pytest.approx((0.1 + 0 + 0.4 + 0) / 4)
    assert pair.difference[2].value == pytest.approx(0.05)


def test_loss_is_against_the_best_of_each_sample(small):
    a, b = lbt.studies.study_statistics(small, ["gain"], ["a", "b"]).controllers
    assert (a.loss.best.count, a.loss.best.total) == (4, 4)
    assert b.loss.best.count == 2
    assert b.loss.loss[0].value == pytest.approx(0.05)


def test_worst_rows_are_the_unstable_then_those_of_least_strehl(small):
    a, b = lbt.studies.study_statistics(small, ["gain"], ["a", "b"], worst=3).controllers
    assert [each.row for each in a.worst] == [11, 12, 14]
    assert [each.stable for each in a.worst] == [False, True, True]
    assert a.worst[1].parameters == {"gain": 0.7}
    assert [each.row for each in b.worst] == [11, 12, 13]
    none = lbt.studies.study_statistics(small, ["gain"], ["a"], worst=0).controllers[0]
    assert none.worst == ()


def test_a_stable_loop_without_light_comes_after_unstable_ones_and_ties_by_row():
    strehl = np.array([0.0, 0.3, 0.3, NAN, 0.3])
    columns = study(
        {}, {"a": strehl}, row=np.array([4, 9, 2, 8, 1]), **{"a.stable": [1, 1, 1, 0, 1]}
    )
    for count in (4, 10):
        worst = lbt.studies.study_statistics(columns, [], ["a"], worst=count).controllers[0].worst
        assert [each.row for each in worst] == [8, 4, 1, 2, 9][:count]


@given(seed=st.integers(0, 10_000))
def test_the_order_of_samples_is_of_no_matter(seed):
    rng = np.random.default_rng(seed)
    columns = study(
        {"p": rng.random(60), "q": rng.integers(0, 3, 60) * 10.0},
        {"a": rng.random(60), "b": rng.random(60)},
        row=np.arange(60),
    )
    columns["a.stable"][rng.random(60) < 0.2] = 0
    columns["b.stable"][rng.random(60) < 0.2] = NAN
    order = rng.permutation(60)
    here = lbt.studies.study_statistics(columns, ["p", "q"], ["a", "b"])
    there = lbt.studies.study_statistics(
        {name: values[order] for name, values in columns.items()}, ["p", "q"], ["a", "b"]
    )
    assert [t.rows for t in lbt.studies.summary_tables(here)] == [
        t.rows for t in lbt.studies.summary_tables(there)
    ]
    for one, other in zip(here.controllers, there.controllers, strict=True):
        assert [w.row for w in one.worst] == [w.row for w in other.worst]


def test_a_controller_that_always_failed_has_dashes_and_no_numbers():
    columns = study({"p": np.linspace(0, 1, 50)}, {"a": np.linspace(0, 1, 50)})
    columns |= {"b.stable": np.full(50, NAN), "b.strehl": np.full(50, NAN)}
    columns["b.residual_nm"] = np.full(50, NAN)
    found = lbt.studies.study_statistics(columns, ["p"], ["a", "b"])
    assert found.controllers[1].samples == 0
    assert found.controllers[1].failed == 50
    assert found.controllers[1].worst == ()
    first = lbt.studies.summary_tables(found)[0]
    column = {row[0]: text(row[2]) for row in first.rows if len(row) > 1}
    assert (column.pop("evaluated"), column.pop("failed")) == ("0", "50")
    assert set(column.values()) == {"-"}


def text(cell):
    return cell if isinstance(cell, str) else cell.text


def test_tables(small):
    found = lbt.studies.study_statistics(small, ["gain"], ["a", "b"])
    tables = {table.caption.split(" over")[0]: table for table in lbt.studies.summary_tables(found)}
    assert len(tables) == 3  # too few samples for indices
    strehl = {text(row[0]): text(row[1]) for row in tables["Strehl ratio"].rows if len(row) > 1}
    assert strehl["mean ± standard error"] == "45.00 ± 17.08"
    assert strehl["50th percentile"] == "50.0"
    assert strehl["above 50 %"].startswith("50.0 (6.8 to 93.2")
    assert strehl["unstable, counted as 0"].startswith("25.00 (0.63 to 80.59")
    assert (strehl["evaluated"], strehl["failed"]) == ("4", "1")
    residual = {row[0]: row[1] for row in tables["Residual of tip and tilt"].rows if len(row) > 1}
    assert residual["99th percentile"] == "unstable"
    assert residual["of noise"] == "20.0"
    worst = worst_table(found.controllers[0], ["gain"])
    assert [text(cell) for cell in worst.rows[0]] == ["11", "unstable", "0.6"]
    assert [text(cell) for cell in worst.rows[1]] == ["12", "40.0", "0.7"]


def test_a_table_compares_every_pair(small):
    small |= {name.replace("b.", "c."): small[name] for name in list(small) if name[:2] == "b."}
    found = lbt.studies.study_statistics(small, ["gain"], ["a", "b", "c"])
    rows = comparison_table(found).rows
    assert [row[0] for row in rows] == ["a less b", "a less c", "b less c"]
    assert rows[0][1:4] == ("50.0", "50.0", "12.50 ± 9.46")
    assert rows[2][1:4] == ("0.0", "100.0", "0.00 ± 0.00")
    assert rows[2][4:] == ("+0.0", "+0.0", "+0.0")


def test_tables_of_one_controller_have_no_comparison():
    columns = study({"p": np.linspace(0, 1, 50)}, {"a": np.linspace(0, 1, 50)})
    found = lbt.studies.study_statistics(columns, ["p"], ["a"])
    captions = [table.caption for table in lbt.studies.summary_tables(found)]
    assert not any("same samples" in caption for caption in captions)
    index = next(t for t in lbt.studies.summary_tables(found) if t.caption.startswith("Variance"))
    assert [row[0] for row in index.rows] == [
        "p",
        "all of them",
        "sum",
        "only together (interactions)",
    ]
    assert index.rows[0][1] == "100.0 ± 0.0"
    named = sensitivity_table(found, names={"p": "short"})
    assert named.rows[0][0] == "short"


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (
            {"a.stable": [1, 2, 1, 1, 1]},
            lbt.errors.ProblemError,
            "must be 1, 0 or nan; got 2 at index 1",
        ),
        (
            {"a.strehl": [NAN] * 5},
            lbt.errors.NonFiniteError,
            "finite and within .0, 1.*got nan at index 0",
        ),
        (
            {"a.strehl": [1.2, 0, 0, 0, 0]},
            lbt.errors.ProblemError,
            "within .0, 1.*got 1.2 at index 0",
        ),
        ({"a.residual_nm": [-1, 0, 0, 0, 0]}, lbt.errors.ProblemError, "at least 0 .*got -1"),
        ({"a.residual_nm": [np.inf, 0, 0, 0, 0]}, lbt.errors.NonFiniteError, "got inf at index 0"),
        ({"b.stable": [1, 1]}, lbt.errors.DimensionError, "'b.stable' must have 5 rows"),
        ({"a.strehl": [1, 1]}, lbt.errors.DimensionError, "'a.strehl' must have 5 rows"),
        ({"gain": [1, 2, NAN, 4, 5]}, lbt.errors.NonFiniteError, "'gain' must be finite; got nan"),
        ({"gain": [[1, 2]]}, lbt.errors.DimensionError, "'gain' must have 5 rows"),
        ({"gain": list("abcde")}, lbt.errors.ProblemError, "'gain' must be an array of numbers"),
        ({"row": [0, 1, NAN, 3, 4]}, lbt.errors.NonFiniteError, "'row' must be finite"),
    ],
)
def test_columns_that_cannot_be_are_refused(small, change, error, says):
    with pytest.raises(error, match=says):
        lbt.studies.study_statistics(small | change, ["gain"], ["a", "b"])


@pytest.mark.parametrize(
    ("arguments", "options", "says"),
    [
        ((["gain"], ["c"]), {}, "must have a column 'c.stable'"),
        ((["wind"], ["a"]), {}, "must have a column 'wind'"),
        ((["gain"], []), {}, "must name one at least"),
        ((["gain"], ["a", "a"]), {}, "different names"),
        (("gain", ["a"]), {}, "parameters must be a list"),
        ((["gain"], ["a"]), {"levels": [1.5]}, "levels must be at most 1"),
        ((["gain"], ["a"]), {"worst": -1}, "worst must be at least 0"),
        ((["gain"], ["a"]), {"worst": 1.5}, "worst must be an integer"),
    ],
)
def test_arguments_that_cannot_be_are_refused(small, arguments, options, says):
    with pytest.raises(lbt.errors.ProblemError, match=says):
        lbt.studies.study_statistics(small, *arguments, **options)
