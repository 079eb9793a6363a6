"""A league on short records: its scores, and how it resumes."""

from __future__ import annotations

import json
import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.league import GAIN, QUICK, short_record, short_split

import lbt_synth as lbt
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.identification.prediction.paired_residuals import chunk_squares
from lbt_synth.studies.league import run as league_run
from lbt_synth.studies.league.entries import all_entries
from lbt_synth.studies.study.cluster import connect_cluster

OPTIONS = {"sensor_gain": GAIN, "most_lines": 2}
NAMES = ("ran", "best-integrator", "kalman")


@pytest.fixture(scope="module")
def league(tmp_path_factory):
    folder = tmp_path_factory.mktemp("league")
    records = {"night": short_record()}
    found = lbt.studies.run_league(
        records, folder, entries=QUICK, splits=2, options={"night": OPTIONS}
    )
    return folder, found


def test_scores_are_what_the_entries_leave(league):
    _, found = league
    split = short_split()
    for name in QUICK:
        exact = chunk_squares(all_entries()[name].residual(split), 500.0)
        assert found.records[0].splits[0].squares_nm2[name] == pytest.approx(exact, rel=1e-12)
    assert found.records[0].splits[0].noise_nm2 == split.noise_nm2
    order = [row.name for row in found.standings]
    assert order[0] == "kalman"
    assert order[-2:] == ["best-integrator", "ran"]
    assert len(found.scores) == 8


def test_it_resumes_and_takes_more_entries(league, monkeypatch):
    folder, before = league
    calls = []
    monkeypatch.setattr(
        league_run, "run_entry", lambda *given: calls.append(given) or pytest.fail("ran again")
    )
    steps = []
    again = lbt.studies.run_league(
        {"night": short_record()}, folder, entries=NAMES, splits=2,
        options={"night": OPTIONS}, progress=steps.append,
    )  # fmt: skip
    assert (sum(steps), calls) == (6, [])
    assert again.records[0].total.residual_nm2("kalman") == before.records[0].total.residual_nm2(
        "kalman"
    )


def test_results_of_other_settings_are_refused(league):
    folder, _ = league
    with pytest.raises(OutputError, match="is the result of other settings"):
        lbt.studies.run_league({"night": short_record()}, folder, entries=["ran"], splits=2)
    with pytest.raises(OutputError, match="is the result of other settings"):
        lbt.studies.run_league(
            {"night": short_record(1)}, folder, entries=["ran"], splits=2,
            options={"night": OPTIONS},
        )  # fmt: skip


def test_any_executor_gives_the_same(league, tmp_path):
    _, found = league
    with ThreadPoolExecutor(2) as executor:
        same = lbt.studies.run_league(
            {"night": short_record()}, tmp_path, entries=NAMES, splits=2, executor=executor,
            options={"night": OPTIONS},
        )  # fmt: skip
    for name in NAMES:
        assert np.array_equal(
            same.records[0].total.squares_nm2[name], found.records[0].total.squares_nm2[name]
        )


def test_what_a_case_needs_reaches_another_process():
    """Processes and hosts get the function with the record, and the case."""
    function = partial(league_run.run_entry, short_record(), OPTIONS)
    case = league_run.record_cases("n", short_record(), OPTIONS, ["ran"], 2)["n-1-ran"]
    assert pickle.loads(pickle.dumps(function))(case) == function(case)


def test_what_fails_is_left_out_and_says_why(tmp_path):
    records = {
        "night": short_record(),
        "open": replace(short_record(closed=False), delay_frames=2.0),
        "brief": replace(short_record(), usable=np.arange(9000) < 600),
    }
    options = {name: OPTIONS if name != "open" else {"most_lines": 2} for name in records}
    found = lbt.studies.run_league(
        records, tmp_path, entries=["ran", "least-squares-32"], splits=1, options=options
    )
    assert [scores.name for scores in found.records] == ["night", "open"]
    assert "nothing ran" in found.records[1].failures["ran"]
    assert list(found.failures) == ["brief"]
    rows = {row.name: row for row in found.standings}
    assert (rows["ran"].records, rows["least-squares-32"].records) == (1, 2)
    with pytest.raises(ProblemError, match="no record could be used: brief: "):
        lbt.studies.run_league({"brief": records["brief"]}, tmp_path / "x", entries=["ran"])


def test_an_entry_that_is_not_installed_has_no_case(tmp_path, monkeypatch):
    monkeypatch.setattr(league_run, "choose_entries", without_pyrtc(league_run.choose_entries))
    found = lbt.studies.run_league(
        {"night": short_record()}, tmp_path, entries=["ran", "pyrtc-ar-kalman"], splits=1,
        options={"night": OPTIONS},
    )  # fmt: skip
    assert sorted(os.listdir(tmp_path / "cases")) == [".lock", "night-1-ran.json"]
    last = found.standings[-1]
    assert (last.name, last.rank, last.note) == ("pyrtc-ar-kalman", None, "not installed")
    with pytest.raises(ProblemError, match="no entry can run here"):
        lbt.studies.run_league({"night": short_record()}, tmp_path, entries=["pyrtc-ar-kalman"])


def without_pyrtc(choose):
    def chosen(names):
        return {
            name: replace(entry, missing="not installed") if name.startswith("pyrtc") else entry
            for name, entry in choose(names).items()
        }

    return chosen


def test_an_entry_that_leaves_nan_has_failed(monkeypatch):
    entry = all_entries()["ran"]
    monkeypatch.setattr(
        league_run, "all_entries",
        lambda: {"ran": replace(entry, residual=lambda split: split.measured() * np.nan)},
    )  # fmt: skip
    case = {"record": "-", "options": {}, "splits": 2, "version": "-", "split": 0, "entry": "ran"}
    found = league_run.run_entry(short_record(), OPTIONS, case)
    assert found == {"error": "its loop is unstable: what it leaves is not finite"}


def test_a_case_depends_on_the_record_and_the_options():
    one = league_run.record_cases("n", short_record(), OPTIONS, ["ran"], 1)["n-1-ran"]
    line = lbt.identification.LinePrior(frequency_hz=40.0, frequency_error_hz=0.1)
    others = [
        league_run.record_cases("n", record, options, ["ran"], 1)["n-1-ran"]
        for record, options in (
            (short_record(1), OPTIONS),
            (short_record().with_delay(3), OPTIONS),
            (short_record(), OPTIONS | {"announced": (line,)}),
        )
    ]
    texts = {json.dumps(case, sort_keys=True) for case in (one, *others)}
    assert len(texts) == 4


def test_a_league_needs_records(tmp_path):
    with pytest.raises(ProblemError, match="at least one record"):
        lbt.studies.run_league({}, tmp_path)


@pytest.mark.e2e
def test_a_dask_cluster_gives_the_same(league, tmp_path, cluster):
    _, found = league
    with connect_cluster(cluster.scheduler_address) as (executor, _):
        same = lbt.studies.run_league(
            {"night": short_record()}, tmp_path, entries=NAMES, splits=2, executor=executor,
            options={"night": OPTIONS},
        )  # fmt: skip
    for name in NAMES:
        squares = [each.records[0].total.squares_nm2[name] for each in (same, found)]
        assert np.array_equal(*squares)
