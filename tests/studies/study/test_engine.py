"""Batches of a study on executors, and processes that die."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from support.studies import (
    assert_whole,
    evaluate_quickly,
    load_small_study,
    make_folder,
    read_table,
)

import lbt_synth as lbt
from lbt_synth.errors import NumericalError
from lbt_synth.studies.study.engine import DIED, BatchQueue, Workers
from lbt_synth.studies.study.store import list_parts


def sizes_of(batches, seconds):
    out = []
    while batches.left:
        start, stop = batches.take()
        out.append((start, stop))
        batches.learn(stop - start, seconds(stop - start))
    assert all(start < stop for start, stop in out)
    return out


def test_batches_follow_what_is_measured():
    given = sizes_of(BatchQueue([(0, 10), (20, 1_000_000)], 2), lambda rows: 1e-4 * rows)
    assert given[:2] == [(0, 4), (4, 10)]  # to the end of a range
    assert [start for start, _ in given[3:]] == [stop for _, stop in given[2:-1]]
    assert given[2][0] == 20
    assert given[-1][1] == 1_000_000
    sizes = [stop - start for start, stop in given]
    assert sizes[2:7] == [24, 96, 384, 1536, 6144]
    assert sizes[7:40] == [15_000] * 33  # a second and a half
    assert sizes[-1] <= 1000  # none waits long for the last
    assert len(sizes) < 100


def test_batches_are_longer_where_each_costs_something():
    given = sizes_of(BatchQueue([(0, 1_000_000)], 2), lambda rows: 0.5 + 1e-4 * rows)
    sizes = [stop - start for start, stop in given]
    assert max(sizes) == 65_536
    assert len(sizes) < 45  # twenty seconds of a hundred, and shares at the end


def test_the_first_batch_may_be_slow():
    seconds = iter([30.0])
    given = sizes_of(BatchQueue([(0, 10_000)], 2), lambda rows: next(seconds, 1e-3 * rows))
    assert max(stop - start for start, stop in given) == 1500
    assert len(given) < 30


def test_slow_rows_come_one_by_one():
    given = sizes_of(BatchQueue([(0, 40)], 2), lambda rows: 10.0 * rows)
    assert [stop - start for start, stop in given] == [4] + [1] * 36
    long = BatchQueue([(0, 10**8)], 2)
    for rows in (100, 1000):
        long.learn(rows, 1e-3 * rows)
    assert long.take() == (0, 4000)  # at most four times what was measured
    long.learn(65_536, 65.536)
    assert long.take()[1] - 4000 > 24_000  # a file every 25 s rather than a million files


def wrong(study, values, start):
    return {"a": 1}


def short(study, values, start):
    return evaluate_quickly(study, values[:-1], start)


def raises(study, values, start):
    raise RuntimeError("no such thing.")


@pytest.mark.parametrize(
    ("evaluate", "message"),
    [
        (wrong, "must return a BatchResult of rows 0 to"),
        (short, "must return a BatchResult of rows 0 to"),
        (raises, r"rows 0 to 3 could not be computed \(RuntimeError: no such thing\)"),
    ],
)
def test_evaluations_that_are_none(tmp_path, evaluate, message):
    with pytest.raises(NumericalError, match=message):
        lbt.studies.run_study(load_small_study(tmp_path), make_folder(tmp_path), evaluate=evaluate)


def test_any_executor(tmp_path):
    study = load_small_study(tmp_path, samples="300")
    with ThreadPoolExecutor(3) as pool:
        lbt.studies.run_study(
            study, folder := make_folder(tmp_path), executor=pool, evaluate=evaluate_quickly
        )
        assert pool.submit(int, "3").result() == 3  # it was left open
    assert_whole(folder, study)


class Breaks(ThreadPoolExecutor):
    """An executor that ends after some calls."""

    calls = 0
    kind = BrokenExecutor

    def submit(self, fn, *args, **kwargs):
        Breaks.calls += 1
        if Breaks.calls <= 3:
            return super().submit(fn, *args, **kwargs)
        if self.kind is BrokenExecutor:
            raise BrokenExecutor("it is gone")
        lost: Future = Future()
        lost.cancel()
        lost.set_running_or_notify_cancel()
        return lost


@pytest.mark.usefixtures("small_batches")
@pytest.mark.parametrize(
    ("kind", "message"),
    [(BrokenExecutor, "the executor broke: it is gone"), (None, "the executor cancelled")],
)
def test_an_executor_that_breaks_keeps_what_is_finished(tmp_path, kind, message):
    study, folder = load_small_study(tmp_path, samples="300"), make_folder(tmp_path)
    Breaks.calls, Breaks.kind = 0, kind
    with Breaks(1) as pool, pytest.raises(NumericalError, match=message):
        lbt.studies.run_study(study, folder, executor=pool, evaluate=evaluate_quickly)
    assert 1 <= len(list_parts(folder)) <= 3
    lbt.studies.run_study(study, folder, evaluate=evaluate_quickly)
    assert_whole(folder, study)


def dies(study, values, start):
    """Row 3 always ends its process, row 9 does once."""
    rows = range(start, start + len(values))
    once = Path(os.environ["STUDY_DIED"])
    if 9 in rows and not once.exists():
        once.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    if 3 in rows and os.environ.get("STUDY_POISON"):
        while not once.exists():  # row 9 dies beside others, not when it is run again alone
            time.sleep(0.01)
        os._exit(7)
    return evaluate_quickly(study, values, start)


@pytest.mark.usefixtures("small_batches")
def test_processes_that_die(tmp_path, monkeypatch):
    monkeypatch.setenv("STUDY_DIED", str(tmp_path / "died"))
    monkeypatch.setenv("STUDY_POISON", "1")
    study, folder = load_small_study(tmp_path, samples="10"), make_folder(tmp_path)
    run = lbt.studies.run_study(study, folder, jobs=2, evaluate=dies)
    assert (tmp_path / "died").exists()
    assert (run.computed, run.failures, run.retry) == (10, 1, 1)
    found = read_table(folder / "results.csv")
    np.testing.assert_array_equal(found["row"], np.arange(10))
    assert np.flatnonzero(np.isnan(found["slow.strehl"])).tolist() == [3]
    lines = (folder / "failed.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines[1:]] == ["3"]
    assert DIED in lines[1]
    monkeypatch.delenv("STUDY_POISON")

    def interrupted(results):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # its tables are new, what it knows of them is not
        lbt.studies.run_study(study, folder, evaluate=dies, whole=interrupted)
    again = lbt.studies.run_study(study, folder, evaluate=dies)  # only that is tried again
    assert (again.computed, again.failures, again.retry) == (0, 0, 0)
    assert_whole(folder, study)


def always_dies(study, values, start):
    os._exit(3)


def test_processes_that_die_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr("lbt_synth.studies.study.engine._MOST_DEATHS", 0)
    study = load_small_study(tmp_path, samples="400")
    with pytest.raises(NumericalError, match="1 times in a row a process died"):
        lbt.studies.run_study(study, make_folder(tmp_path), jobs=2, evaluate=always_dies)


def only_in(process):
    """Return the number of this process, and end any but one of them."""
    if process not in (None, os.getpid()):
        os._exit(1)
    return os.getpid()


def test_a_call_begins_in_another_process_if_there_are_some(tmp_path):
    study = load_small_study(tmp_path)
    with Workers(study, evaluate=evaluate_quickly, jobs=2) as engine:
        assert engine.begin(only_in, None)() != os.getpid()
        assert engine.begin(only_in, os.getpid())() == os.getpid()  # its process died
        assert engine.begin(only_in, os.getpid())() == os.getpid()  # there is none any more
        with pytest.raises(ZeroDivisionError):
            engine.begin(divmod, 1, 0)()
    with Workers(study, evaluate=evaluate_quickly) as engine:
        assert engine.begin(only_in, None)() == os.getpid()
        with pytest.raises(ZeroDivisionError):
            engine.begin(divmod, 1, 0)


@pytest.mark.parametrize("workers", [-1, 100])
def test_workers_are_those_of_an_executor(tmp_path, workers):
    """A study without one never ended with -1."""
    study = load_small_study(tmp_path, samples="8")
    with Workers(study, evaluate=evaluate_quickly, jobs=2, workers=workers) as engine:
        assert (engine.at_once, engine.in_flight) == (2, 4)
