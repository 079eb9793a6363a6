"""Statistics of studies."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.study_results import make_columns

from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.studies import study_statistics, summary_tables

NAN = float("nan")


def test_unstable_counts_as_zero_and_failed_is_left_out(small):
    found = study_statistics(small, ["gain"], ["a", "b"], levels=[0.5])
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
    pair = study_statistics(small, ["gain"], ["a", "b"]).comparisons[0]
    assert (pair.first, pair.second) == ("a", "b")
    assert pair.better.total == 4
    assert pair.better.count == 2  # rows 10 and 12
    assert pair.equal.count == 2  # both unstable in row 11, the same in row 14
    assert pair.mean == pytest.approx((0.1 + 0 + 0.4 + 0) / 4)
    assert pair.difference[2].value == pytest.approx(0.05)


def test_loss_is_against_the_best_of_each_sample(small):
    a, b = study_statistics(small, ["gain"], ["a", "b"]).controllers
    assert (a.loss.best.count, a.loss.best.total) == (4, 4)
    assert b.loss.best.count == 2
    assert b.loss.loss[0].value == pytest.approx(0.05)


def test_worst_rows_are_the_unstable_then_those_of_least_strehl(small):
    a, b = study_statistics(small, ["gain"], ["a", "b"], worst=3).controllers
    assert [each.row for each in a.worst] == [11, 12, 14]
    assert [each.stable for each in a.worst] == [False, True, True]
    assert a.worst[1].parameters == {"gain": 0.7}
    assert [each.row for each in b.worst] == [11, 12, 13]
    none = study_statistics(small, ["gain"], ["a"], worst=0).controllers[0]
    assert none.worst == ()


def test_a_stable_loop_without_light_comes_after_unstable_ones_and_ties_by_row():
    strehl = np.array([0.0, 0.3, 0.3, NAN, 0.3])
    columns = make_columns(
        {}, {"a": strehl}, row=np.array([4, 9, 2, 8, 1]), **{"a.stable": [1, 1, 1, 0, 1]}
    )
    for count in (4, 10):
        worst = study_statistics(columns, [], ["a"], worst=count).controllers[0].worst
        assert [each.row for each in worst] == [8, 4, 1, 2, 9][:count]


@given(seed=st.integers(0, 10_000))
def test_the_order_of_samples_is_of_no_matter(seed):
    rng = np.random.default_rng(seed)
    columns = make_columns(
        {"p": rng.random(60), "q": rng.integers(0, 3, 60) * 10.0},
        {"a": rng.random(60), "b": rng.random(60)},
        row=np.arange(60),
    )
    columns["a.stable"][rng.random(60) < 0.2] = 0
    columns["b.stable"][rng.random(60) < 0.2] = NAN
    order = rng.permutation(60)
    here = study_statistics(columns, ["p", "q"], ["a", "b"])
    there = study_statistics(
        {name: values[order] for name, values in columns.items()}, ["p", "q"], ["a", "b"]
    )
    assert [t.rows for t in summary_tables(here)] == [t.rows for t in summary_tables(there)]
    for one, other in zip(here.controllers, there.controllers, strict=True):
        assert [w.row for w in one.worst] == [w.row for w in other.worst]


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"a.stable": [1, 2, 1, 1, 1]}, ProblemError, "must be 1, 0 or nan; got 2 at index 1"),
        ({"a.strehl": [NAN] * 5}, NonFiniteError, "finite and within .0, 1.*got nan at index 0"),
        ({"a.strehl": [1.2, 0, 0, 0, 0]}, ProblemError, "within .0, 1.*got 1.2 at index 0"),
        ({"a.residual_nm": [-1, 0, 0, 0, 0]}, ProblemError, "at least 0 .*got -1"),
        ({"a.residual_nm": [np.inf, 0, 0, 0, 0]}, NonFiniteError, "got inf at index 0"),
        ({"b.stable": [1, 1]}, DimensionError, "'b.stable' must have 5 rows"),
        ({"a.strehl": [1, 1]}, DimensionError, "'a.strehl' must have 5 rows"),
        ({"gain": [1, 2, NAN, 4, 5]}, NonFiniteError, "'gain' must be finite; got nan"),
        ({"gain": [[1, 2]]}, DimensionError, "'gain' must have 5 rows"),
        ({"gain": list("abcde")}, ProblemError, "'gain' must be an array of numbers"),
        ({"row": [0, 1, NAN, 3, 4]}, NonFiniteError, "'row' must be finite"),
    ],
)
def test_columns_that_cannot_be_are_refused(small, change, error, says):
    with pytest.raises(error, match=says):
        study_statistics(small | change, ["gain"], ["a", "b"])


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
    with pytest.raises(ProblemError, match=says):
        study_statistics(small, *arguments, **options)


def test_rounding_is_neither_better_nor_worse() -> None:
    """The table of results has 9 digits, and the same filter by two routes differs below them."""
    strehl = np.random.default_rng(0).random(200)
    columns = make_columns({}, {"a": strehl, "b": strehl + 1e-8, "c": strehl + 1e-4})
    found = study_statistics(columns, [], ["a", "b", "c"])
    first = found.comparisons[0]
    assert (first.better.count, first.equal.count) == (0, 200)
    assert [each.loss.best.count for each in found.controllers] == [0, 0, 200]
    both = study_statistics(columns, [], ["a", "b"])
    assert [each.loss.best.count for each in both.controllers] == [200, 200]
