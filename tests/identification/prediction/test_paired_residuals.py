"""Residuals on the same frames, and block-bootstrap errors of their differences."""

import numpy as np
import pytest
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.prediction.paired_residuals import (
    CHUNK_S,
    bootstrap_error,
    choose_block_length,
    chunk_squares,
)

PairedResiduals = lbt.identification.PairedResiduals


def correlated(rng, pole, count, size):
    """``size`` AR1 series, (size, count)."""
    return lfilter([1], [1, -pole], rng.standard_normal((size, count + 500)), axis=1)[:, 500:]


@pytest.mark.parametrize("length", [1, 4, 12])
def test_the_error_is_that_of_drawn_blocks(length):
    rng = np.random.default_rng(3)
    values = correlated(rng, 0.7, 96, 1)[0]
    count = len(values) // length
    starts = rng.integers(len(values), size=(40_000, count))
    means = np.mean(values[(starts[..., None] + np.arange(length)) % len(values)], axis=(1, 2))
    drawn = np.std(means) * np.sqrt(count / (count - 1))  # as n - 1 in a sample's variance
    assert bootstrap_error(values, length) == pytest.approx(drawn, rel=0.02)


@pytest.mark.parametrize("pole", [0.3, 0.6, 0.8])
def test_the_length_of_a_block_is_about_the_best_of_an_ar1_process(pole):
    count = 2000
    rng = np.random.default_rng(5)
    found = [choose_block_length(series) for series in correlated(rng, pole, count, 60)]
    best = (1.5 * (2 * pole / (1 - pole**2)) ** 2 * count) ** (1 / 3)
    assert np.median(found) == pytest.approx(best, rel=0.3)


@pytest.mark.parametrize("pole", [0.0, 0.6])
def test_the_error_of_a_mean_is_right(pole):
    count = 600
    rng = np.random.default_rng(6)
    series = correlated(rng, pole, count, 300)
    errors = [bootstrap_error(each) for each in series]
    assert np.mean(errors) == pytest.approx(1 / (1 - pole) / np.sqrt(count), rel=0.12)


def test_what_does_not_change_has_no_error():
    assert choose_block_length(np.full(20, 3.0)) == 1
    assert bootstrap_error(np.full(20, 3.0)) == 0


def test_chunks_are_mean_squares_over_both_axes():
    rng = np.random.default_rng(0)
    series = rng.standard_normal((1030, 2))
    chunks = chunk_squares(series, 1000.0)
    size = round(CHUNK_S * 1000)
    assert chunks.shape == (1030 // size,)
    assert chunks[3] == pytest.approx(np.sum(series[3 * size : 4 * size] ** 2) / size)


def test_paired_differences_are_more_certain_than_either():
    rng = np.random.default_rng(1)
    air = 300 * correlated(rng, 0.8, 400, 1)[0] ** 2
    good, bad = (air + level + rng.standard_normal(400) for level in (10, 12))
    pair = PairedResiduals(squares_nm2={"bad": bad, "good": good}, noise_nm2=5)
    assert pair.names == ("good", "bad")
    assert pair.best == "good"
    assert pair.residual_nm2("good") == pytest.approx(np.mean(good) - 5)
    difference, error = pair.above("bad", "good")
    assert difference == pytest.approx(np.mean(bad) - np.mean(good))
    assert error < pair.error_nm2("good") / 20
    assert abs(difference - 2) < 4 * error
    assert pair.above("good", "bad") == pytest.approx((-difference, error))


@pytest.mark.parametrize(
    ("squares", "kind", "words"),
    [
        ({}, ProblemError, "at least one controller"),
        ({"a": np.ones(7)}, ProblemError, "at least 8 chunks"),
        ({"a": np.ones(9), "b": np.ones(10)}, DimensionError, "the same chunks"),
        ({"a": [1.0] * 8 + [np.nan]}, ProblemError, "squares_nm2 of a"),
    ],
)
def test_residuals_that_cannot_be_compared(squares, kind, words):
    with pytest.raises(kind, match=words):
        PairedResiduals(squares_nm2=squares)


def test_a_controller_that_is_not_there():
    pair = PairedResiduals(squares_nm2={"a": np.ones(9)})
    with pytest.raises(ProblemError, match="must be one of a; got 'b'"):
        pair.above("a", "b")


def test_an_error_needs_values():
    with pytest.raises(ProblemError, match="at least 8 values; got 7"):
        bootstrap_error(np.ones(7))
    with pytest.raises(ProblemError, match="block"):
        bootstrap_error(np.ones(40), block=11)
