"""Trained on the past of a record, tested on what follows.

Residuals on the same frames, and block-bootstrap errors of their differences.
"""

import runpy
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from support.night import GAIN, night_record, simulated_night
from support.plants import ROOT
from support.short_split import short_record

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.prediction.forward_chaining import (
    CHUNK_S,
    bootstrap_error,
    choose_block_length,
    chunk_squares,
    forward_split,
    forward_splits,
)

PairedResiduals = lbt.identification.PairedResiduals


@pytest.fixture(scope="module")
def record():
    return night_record()


@pytest.fixture(scope="module")
def split(record):
    training, test = forward_splits(record.stretches(), record.frames, splits=2)[0]
    return forward_split(record, training, test, sensor_gain=GAIN, most_lines=2)


def frames_in(stretches):
    return np.concatenate([np.arange(start, stop) for start, stop in stretches])


def test_tests_cover_the_rest_once_and_follow_their_training():
    usable = [(10, 400), (450, 460), (500, 1001)]
    pairs = forward_splits(usable, 1200, splits=4, first_share=0.4)
    everything = frames_in(usable)
    assert len(pairs) == 4
    for training, test in pairs:
        both = np.concatenate([frames_in(training), frames_in(test)])
        assert np.array_equal(both, everything[: len(both)])
    tests = np.concatenate([frames_in(test) for _, test in pairs])
    assert np.array_equal(tests, everything[-len(tests) :])
    assert len(tests) == pytest.approx(0.6 * len(everything), abs=1)
    lengths = [len(frames_in(test)) for _, test in pairs]
    assert max(lengths) - min(lengths) <= 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"splits": 0}, "splits"),
        ({"first_share": 1.0}, "first_share"),
        ({"splits": 7}, "10 usable frames for 7 splits"),
    ],
)
def test_splits_that_a_record_cannot_have(options, words):
    with pytest.raises(ProblemError, match=words):
        forward_splits([(0, 10)], 10, **options)


def test_a_replay_of_what_ran_is_what_was_measured(split):
    _, _, ran = simulated_night()
    # it starts half a record before, and has forgotten how
    assert np.max(np.abs(split.replay(ran.controller) - split.measured())) < 1e-6
    assert split.measured().shape == (len(frames_in(split.test)), 2)
    assert split.noise_nm2 == pytest.approx(2 * (8.0 / GAIN) ** 2, rel=0.05)


def test_a_replay_is_a_loop_frame_by_frame(split):
    design = lbt.kalman(split.model.plant())
    running = design.controller.start()
    gain = np.array(split.model.sensor_gains)
    z = split.open_loop[split.replayed[0][0] : split.replayed[0][1]]
    commands, left = np.zeros_like(z), np.zeros_like(z)
    for k in range(len(z)):
        left[k] = z[k] - (commands[k - 2] if k >= 2 else 0)
        commands[k] = running.step(gain * left[k])
    assert split.replay(design.controller) == pytest.approx(
        left[-len(split.measured()) :], abs=1e-6
    )


def test_the_future_changes_nothing_before_it(record, split):
    later = split.test[0][1] - 500
    y = record.measurements.copy()
    y[later:] += 1000.0
    changed = replace(record, measurements=y)
    again = forward_split(changed, split.training, split.test, sensor_gain=GAIN, most_lines=2)
    assert again.noise_nm2 == split.noise_nm2
    one, other = (each.replay(lbt.kalman(each.model.plant()).controller) for each in (split, again))
    assert np.array_equal(one[:-500], other[:-500])
    assert np.max(np.abs(one[-500:] - other[-500:])) > 500


def test_frames_where_a_controller_has_just_started_do_not_count(record):
    usable = record.usable.copy()
    usable[8000:8010] = False
    holed = replace(record, usable=usable)
    found = forward_split(
        holed, ((2, 6000),), ((6000, 8000), (8010, 11_000)), sensor_gain=GAIN, most_lines=1
    )
    assert found.test == ((6000, 8000), (8510, 11_000))
    assert found.replayed == ((2, 8000), (8010, 11_000))
    with pytest.raises(ProblemError, match="more than 500 frames"):
        forward_split(holed, ((2, 6000),), ((8010, 8300),))


def test_designs_are_compared_on_what_follows(record, split):
    path = split.hardware
    steps = []
    chain = lbt.identification.forward_chain(
        record,
        {
            "ran": lambda _: lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000), gain=0.4),
            "filter": lambda each: lbt.kalman(each.model.plant()),
            "wild": lambda _: lbt.Controller(
                A=np.eye(2), B=3 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=path.dt_s
            ),
        },
        splits=2,
        sensor_gain=GAIN,
        most_lines=2,
        progress=steps.append,
    )
    assert steps == [1, 1]
    assert chain.names == ("filter", "ran")
    assert list(chain.failures) == ["wild"]
    assert "unstable" in chain.failures["wild"]
    exact = chunk_squares(split.replay(lbt.kalman(split.model.plant()).controller), 1000.0)
    assert np.array_equal(chain.squares_nm2["filter"][: len(exact)], exact)
    difference, error = chain.above("ran", "filter")
    assert difference > 3 * error


def test_a_comparison_without_designs(record):
    with pytest.raises(ProblemError, match="no design can be compared on this record: none given"):
        lbt.identification.forward_chain(record, {}, splits=1, sensor_gain=GAIN, most_lines=1)


def test_a_test_is_at_least_a_second(record):
    with pytest.raises(ProblemError, match="1000 usable frames .* the shortest has 599"):
        lbt.identification.forward_chain(record, {}, splits=10)


def test_the_past_is_the_record_as_it_was(record, split):
    stop = split.training[-1][1]
    assert split.past.frames == stop < record.frames
    assert np.array_equal(split.past.commands, record.commands[:stop])
    assert split.past.stretches() == split.training
    again = lbt.identify(split.past, **split.options)
    assert again.sensor_gains == split.model.sensor_gains


def test_the_league_of_designs_and_rivals(monkeypatch, capsys):
    """The script of the benchmarks ranks a filter of the model above the best integrator."""
    league = runpy.run_path(str(ROOT / "benchmarks/league.py"))
    names = ("best integrator", "least squares, 32 taps", "Kalman")
    entries = {name: league["ENTRIES"][name] for name in names}
    monkeypatch.setitem(league["play"].__globals__, "ENTRIES", entries)
    short = replace(short_record(), usable=np.arange(9000) < 600)
    league["play"]({"night": short_record(), "brief": short}, 2)
    failure, _, heading, *rows = capsys.readouterr().out.splitlines()
    assert failure.startswith("brief is not in the table: each test needs")
    assert heading.split()[-1] == "night"
    assert [row[:26].strip() for row in rows] == ["Kalman", "least squares, 32 taps", names[0]]
    assert float(rows[0].split()[-1]) == 0.0
    assert float(rows[2].split()[-1]) > 20


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
    assert error < bootstrap_error(pair.squares_nm2["good"]) / 20
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
