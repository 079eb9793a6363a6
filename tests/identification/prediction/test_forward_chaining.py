"""Trained on the past of a record, tested on what follows."""

import runpy
from dataclasses import replace

import numpy as np
import pytest
from support.night import GAIN, night_record, simulated_night
from support.plants import ROOT
from support.short_record import short_record

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification.prediction.forward_chaining import forward_split
from lbt_synth.identification.stretches import forward_splits


@pytest.fixture(scope="module")
def record():
    return night_record()


@pytest.fixture(scope="module")
def split(record):
    training, test = forward_splits(record.stretches(), record.frames, splits=2)[0]
    model = lbt.identify(record, stretches=training, sensor_gain=GAIN, most_lines=2)
    return forward_split(record, training, test, model)


def frames_in(stretches):
    return np.concatenate([np.arange(start, stop) for start, stop in stretches])


def test_a_replay_of_what_ran_is_what_was_measured(split):
    _, _, ran = simulated_night()
    # it starts half a record before, and has forgotten how
    measured = split.record.measurements[frames_in(split.test)] / np.array(split.model.sensor_gains)
    assert np.max(np.abs(split.replay(ran.controller) - measured)) < 1e-6
    assert np.trace(split.noise_nm2) == pytest.approx(2 * (8.0 / GAIN) ** 2, rel=0.05)


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
        left[-len(frames_in(split.test)) :], abs=1e-6
    )


def test_the_future_changes_nothing_before_it(record, split):
    later = split.test[0][1] - 500
    y = record.measurements.copy()
    y[later:] += 1000.0
    changed = replace(record, measurements=y)
    again = forward_split(changed, split.training, split.test, split.model)
    design = lbt.kalman(split.model.plant())
    one, other = (each.replay(design.controller) for each in (split, again))
    assert np.array_equal(one[:-500], other[:-500])
    assert np.max(np.abs(one[-500:] - other[-500:])) > 500


def test_designs_are_compared_on_what_follows(record, split):
    path = split.hardware
    residuals, failures = lbt.identification.forward_chain(
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
    )
    assert list(residuals) == ["filter", "ran"]
    assert list(failures) == ["wild"]
    assert "unstable" in failures["wild"]
    first = split.replay(lbt.kalman(split.model.plant()).controller)
    assert np.array_equal(residuals["filter"].measured_nm[: len(first)], first)
    assert residuals["filter"].measured_nm2 == pytest.approx(
        np.mean(np.sum(residuals["filter"].measured_nm ** 2, axis=1))
    )
    difference, error = residuals["ran"].above(residuals["filter"])
    assert difference > 3 * error


def test_a_comparison_without_designs(record):
    with pytest.raises(ProblemError, match="no design can be compared on this record: none given"):
        lbt.identification.forward_chain(record, {}, splits=1, sensor_gain=GAIN, most_lines=1)


def test_a_test_is_at_least_a_second(record):
    with pytest.raises(ProblemError, match="1000 usable frames .* the shortest has 599"):
        lbt.identification.forward_chain(record, {}, splits=10)


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
