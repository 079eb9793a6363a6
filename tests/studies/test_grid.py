"""Parts of a sweep on executors, and processes that die."""

from __future__ import annotations

import os
import pickle
import signal
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.plants import LBT_YAML, lbt_axis_plant
from support.studies import assert_whole, evaluate_quickly, load_small_study, make_folder, part_rows

import lbt_synth as lbt
from lbt_synth.errors import NumericalError, OutputError
from lbt_synth.storage import array_file
from lbt_synth.storage.executors import WorkerPool
from lbt_synth.studies import run_study
from lbt_synth.studies.grid import Sweep, evaluate
from lbt_synth.studies.limits import limits


def test_a_sweep_knows_what_is_missing(tmp_path):
    sweep = Sweep(folder=tmp_path / "parts", columns=("a",), rows=12, digest="d" * 64)
    assert sweep.missing() == [(0, 12)]
    sweep.folder.mkdir()
    for start, stop in [(2, 4), (4, 6), (9, 10)]:
        sweep.write((start, stop), ({"a": np.arange(start, stop)}, [(start, "a", "why")]), 0.5)
    assert list(sweep.paths()) == [(2, 4), (4, 6), (9, 10)]
    assert sweep.missing() == [(0, 2), (6, 9), (10, 12)]
    results, failures, seconds = sweep.read(sweep.paths()[4, 6])
    assert (results.tolist(), failures, seconds) == ([[4], [5]], [(4, "a", "why")], 0.5)
    begun = sweep.folder / ".lbt_synth.0123456789abcdef.0.tmp"
    begun.write_bytes(b"half")
    seen, counts = [], []

    def count(start, stop):
        seen.append((start, stop))
        return {"a": np.arange(start, stop)}, []

    run, computed = sweep.run(count, lambda rows: rows, part_rows=2, progress=counts.append)
    assert seen == [(0, 2), (6, 8), (8, 9), (10, 12)]  # a fixed number, and less at an end
    assert run.results.ravel().tolist() == list(range(12))
    assert run.failures == [(2, "a", "why"), (4, "a", "why"), (9, "a", "why")]
    assert (computed, counts) == (7, [5, 2, 2, 1, 2])
    assert not begun.exists()  # what a killed process had begun to write
    assert sweep.run(None, lambda rows: rows, part_rows=2)[1] == 0


class Elsewhere(ThreadPoolExecutor):
    """An executor that gets everything in bytes, as one of processes does."""

    def submit(self, fn, /, *args):
        return super().submit(*pickle.loads(pickle.dumps((fn, *args))))


class Breaks(ThreadPoolExecutor):
    """An executor that ends after three calls, with an error or without a word."""

    def __init__(self, error):
        super().__init__(1)
        self.error, self.calls = error, 0

    def submit(self, fn, *args, **kwargs):
        self.calls += 1
        if self.calls <= 3:
            return super().submit(fn, *args, **kwargs)
        if self.error:
            raise self.error
        lost: Future = Future()
        lost.cancel()
        lost.set_running_or_notify_cancel()
        return lost


def reciprocal(number, seconds):
    time.sleep(seconds)
    return 1 / number


def test_answers_in_memory_are_in_the_order_of_their_samples():
    samples = [(i, 0.05 * (i == 1)) for i in range(1, 9)]
    with Elsewhere(3) as pool:
        assert list(evaluate(reciprocal, iter(samples), pool)) == [1 / i for i, _ in samples]
        with pytest.raises(ZeroDivisionError):  # an error of a sample is as it is here
            list(evaluate(reciprocal, [(1, 0.0), (0, 0.0)], pool))
    killed = type("KilledWorker", (Exception,), {})("a task on 4 workers")  # Dask's own
    for error in (BrokenExecutor("it is gone"), killed, None):
        words = "a worker of the executor died .*Start it again"
        with Breaks(error) as pool, pytest.raises(NumericalError, match=words):
            list(evaluate(reciprocal, samples, pool))


def test_tables_of_designs_are_the_same_elsewhere():
    config = lbt.load_config(LBT_YAML)
    plant, loop = lbt_axis_plant(modes=1), (config.truth, config.imaging)
    design, errors = config.design("integrator", gain=0.3), {"errors_hz": [-1.0, 0.0]}

    def tables(**how):
        yield [
            str(row.values) for row in lbt.studies.robustness(config.plant, *loop, **errors, **how)
        ]
        rows = limits({"slow": design}, config.hardware, *loop, **errors, **how).rows
        yield [str(row.values) for row in rows]
        yield [point.gamma for point in lbt.studies.tradeoff(plant, points=2, **how)]
        gains = {"sensor_gains": np.linspace(0.1, 1, 70), "delay_errors_frames": [0, 0.5]}
        yield lbt.studies.robustness_map(design, *loop, **errors, **gains, **how).strehl.tolist()

    with Elsewhere(2) as pool:
        assert list(tables(executor=pool)) == list(tables())


def test_a_part_is_believed_by_its_digest_alone(tmp_path):
    sweep = Sweep(folder=tmp_path, columns=("a",), rows=2, digest="d" * 64)
    sweep.write((0, 2), ({"a": np.ones(2)}, []), 0.5)
    (path,) = sweep.paths().values()
    arrays, text = array_file.read_npz(path.read_bytes())
    with pytest.raises(OutputError, match="is of another study"):
        replace(sweep, digest="e" * 64).read(path)
    content = path.read_bytes()
    changed = array_file.npz_bytes({"RESULTS": 1.001 * arrays["RESULTS"]}, text)
    for damage in (changed, content[:-30], content[:200] + b"x" + content[201:], b""):
        path.write_bytes(damage)
        with pytest.raises(OutputError, match="is damaged. Delete it"):
            sweep.read(path)
    path.with_name("0000000001-0000000002.npz").write_bytes(content)
    with pytest.raises(OutputError, match="has rows that are in"):
        sweep.paths()


@pytest.mark.parametrize(
    ("evaluate", "words"),
    [
        (lambda *_: {"a": 1}, "ValueError"),
        (lambda study, rows, start: evaluate_quickly(study, rows[1:], start), "ValueError: 3 rows"),
        (lambda *_: 1 / 0, "ZeroDivisionError: division by zero"),
    ],
)
def test_evaluations_that_are_none(tmp_path, evaluate, words):
    with pytest.raises(NumericalError, match=rf"rows 0 to 3 have no result \({words}"):
        run_study(load_small_study(tmp_path), make_folder(tmp_path), evaluate=evaluate)


def test_any_executor(tmp_path):
    study = load_small_study(tmp_path, samples="300")
    with ThreadPoolExecutor(3) as pool:
        run_study(study, folder := make_folder(tmp_path), executor=pool, evaluate=evaluate_quickly)
        assert pool.submit(int, "3").result() == 3  # it was left open
    assert_whole(folder, study)


@pytest.mark.parametrize(
    ("error", "message"),
    [(BrokenExecutor("it is gone"), "BrokenExecutor: it is gone"), (None, "CancelledError")],
)
def test_an_executor_that_breaks_keeps_what_is_finished(tmp_path, error, message):
    study, folder = load_small_study(tmp_path, samples="300"), make_folder(tmp_path)
    words = rf"\({message}\).*start the study again.*it goes on from there"
    with Breaks(error) as pool, pytest.raises(NumericalError, match=words):
        run_study(study, folder, executor=pool, evaluate=evaluate_quickly)
    assert 1 <= len(part_rows(folder)) <= 3
    run_study(study, folder, evaluate=evaluate_quickly)
    assert_whole(folder, study)


def dies_once(study, values, start):
    """Row 30 ends its process, when others are written; the second time it does not."""
    once = Path(os.environ["STUDY_DIED"])
    if start <= 30 < start + len(values) and not once.exists():
        while not part_rows(once.parent / "out"):
            time.sleep(0.01)
        once.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return evaluate_quickly(study, values, start)


def test_a_dead_process_ends_the_run_and_the_next_one_goes_on(tmp_path, monkeypatch):
    monkeypatch.setenv("STUDY_DIED", str(tmp_path / "died"))
    study, folder = load_small_study(tmp_path, samples="80"), make_folder(tmp_path)
    words = "a process died.*start the study again"
    with pytest.raises(NumericalError, match=words), WorkerPool(2) as pool:
        run_study(study, folder, executor=pool, evaluate=dies_once)
    kept = sum(stop - start for start, stop in part_rows(folder))
    assert 0 < kept < 80
    again = run_study(study, folder, evaluate=dies_once)
    assert (again.computed, again.failures) == (80 - kept, ())
    assert_whole(folder, study)
