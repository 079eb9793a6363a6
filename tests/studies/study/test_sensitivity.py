"""Sensitivities of controllers to parameters, and first-order indices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from support.study_results import draw_points, make_columns

import lbt_synth as lbt
from lbt_synth.studies.study.sensitivity import conditional_curve, first_order_index
from lbt_synth.studies.study.summary import varying_parameters


def index(parameter, result):
    order = np.argsort(parameter, kind="stable")
    return first_order_index(parameter[order], result[order])


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
    u = draw_points(kind, n, 4, seed=5)
    found = [index(column, ishigami(u)) for column in u.T]
    np.testing.assert_allclose([each.value for each in found], ishigami_indices(), atol=limit)
    for each, expected in zip(found, ishigami_indices(), strict=True):
        assert abs(each.value - expected) < 4 * each.error


def test_standard_errors_are_those_of_repeated_samples():
    """Mean error, spread over 200 samples, and the mean of the standard errors."""
    n = 1000
    values, errors = np.empty((200, 4)), np.empty((200, 4))
    for seed in range(200):
        u = draw_points("independent", n, 4, seed)
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
    """The correction of independent samples is 31 / 4064 of the unexplained part."""
    u = draw_points("sobol", 4096, 3, seed=3)
    assert abs(index(u[:, 2], ishigami(u)).value) < 1e-3


def test_a_parameter_without_effect_has_no_index():
    u = draw_points("independent", 3000, 2, seed=2)
    found = index(u[:, 1], np.sin(7 * u[:, 0]))
    assert abs(found.value) < 2.5 * found.error
    assert found.error < 0.01


def test_a_list_has_its_values_as_groups():
    rng = np.random.default_rng(0)
    values = rng.choice([10.0, 20.0, 30.0], size=6000, p=[0.5, 0.3, 0.2])
    means = {10.0: 0.2, 20.0: 0.8, 30.0: 0.5}
    exact = np.array([means[v] for v in values])
    result = exact + rng.normal(scale=0.1, size=values.size)
    found = index(values, result)
    mean = 0.5 * 0.2 + 0.3 * 0.8 + 0.2 * 0.5
    between = 0.5 * (0.2 - mean) ** 2 + 0.3 * (0.8 - mean) ** 2 + 0.2 * (0.5 - mean) ** 2
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


@given(shift=st.floats(-5, 5), scale=st.sampled_from([-3.0, 0.01, 7.0]), seed=st.integers(0, 1000))
def test_the_index_knows_no_units(shift, scale, seed):
    u = draw_points("independent", 150, 2, seed)
    result = u[:, 0] ** 2 + 0.3 * u[:, 1]
    here = index(u[:, 0], result)
    there = index(np.exp(3 * u[:, 0]), shift + scale * result)
    assert there.value == pytest.approx(here.value, abs=1e-9)
    assert there.error == pytest.approx(here.error, abs=1e-9)


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


@pytest.mark.parametrize("kind", ["independent", "latin", "sobol"])
@pytest.mark.parametrize("n", [512, 4096])
def test_an_edge_is_blurred_within_its_group_alone(kind, n):
    """A loop that is unstable beyond 0.9 has a Strehl ratio of 0 there."""
    u = draw_points(kind, n, 2, seed=2)
    x, y = u.T
    found = index(x, np.where(x > 0.9, 0.0, 0.8 - 0.2 * y))
    between, within = 0.09 * 0.7**2, 0.9 * 0.2**2 / 12
    blurred = (
        0.7**2 / 4 / (16 if n == 4096 else 8)
    )  # a step in the middle of a group, without a line
    missing = between / (between + within) - found.value
    assert -3 * found.error < missing < blurred / (between + within) + 3 * found.error


def test_one_odd_sample_makes_no_index():
    """One unstable loop of 1000 gave a parameter without effect an index of 0.8."""
    rng = np.random.default_rng(0)
    quiet = 0.82 + 0.005 * rng.normal(size=1000)
    found = []
    for place in rng.integers(0, 1000, 60):
        result = quiet.copy()
        result[place] = 0.0
        found.append(first_order_index(np.arange(1000.0), result).value)
    assert np.max(np.abs(found)) < 0.05


def test_a_list_of_independent_samples_keeps_its_correction():
    rng = np.random.default_rng(1)
    found = [
        first_order_index(np.sort(rng.integers(0, 10, 1024) * 1.0), rng.normal(size=1024)).value
        for _ in range(100)
    ]
    assert abs(np.mean(found)) < 0.003


@pytest.mark.parametrize("shuffled", [False, True])
def test_the_order_of_tied_samples_makes_no_index(shuffled):
    """A grid of 64 x 64 gave the parameter without effect 0.32."""
    one, other = (each.ravel() for each in np.meshgrid(np.arange(64.0), np.arange(64.0)))
    order = np.random.default_rng(1).permutation(4096) if shuffled else np.arange(4096)
    columns = make_columns({"a": other[order], "b": one[order]}, {"k": one[order] / 64})
    (found,) = lbt.studies.study_statistics(columns, ["a", "b"], ["k"]).sensitivities
    assert abs(found.find("a").index.value) < 0.01
    assert found.find("b").index.value == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("scale", [1e-300, 1e-170, 1.0, 1e300])
def test_the_index_knows_no_scale(scale):
    x = np.linspace(0, 1, 100)
    assert first_order_index(x, scale * x).value == pytest.approx(1)


def test_a_value_that_one_sample_has_makes_no_swing():
    rng = np.random.default_rng(0)
    x = np.append(rng.choice([10.0, 20.0], 4095), 30.0)
    columns = make_columns({"x": x}, {"a": np.append(0.5 + 0.1 * rng.random(4095), 0.9)})
    (found,) = lbt.studies.study_statistics(columns, ["x"], ["a"]).sensitivities
    assert found.find("x").swing < 0.01
    assert np.isfinite(found.find("x").swing_error)
