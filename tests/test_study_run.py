"""Runs of studies: parts, faults, results, replays."""

from __future__ import annotations

import errno
import json
import os
import signal
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from support.studies import LBT_TEXT, loaded

import lbt_synth as lbt
from lbt_synth.errors import MissingExtraError, NumericalError, OutputError, ProblemError
from lbt_synth.studies.study.batch_queue import BatchQueue
from lbt_synth.studies.study.engine import DIED
from lbt_synth.studies.study.store import list_parts, missing_rows

ONE = "truth.vibrations[0].rms_nm"
TWO = "{a: {design: kalman}, b: {design: integrator, gain: 0.4}}"


def quick(study, values, start):
    """Columns that tell which row they are of."""
    rows = start + np.arange(len(values))
    columns = {name: rows + values[:, 0] / 7 + i for i, name in enumerate(study.result_columns)}
    return lbt.studies.BatchResult(start=start, columns=columns)


@pytest.fixture
def small_batches(monkeypatch):
    """As if every row took long: batches are shares of what is left."""
    monkeypatch.setattr("lbt_synth.studies.study.batch_queue._CRUMB_SECONDS", 0.0)


def output(tmp_path, name="out"):
    folder = tmp_path / name
    folder.mkdir()
    return folder


def table(path):
    with path.open() as stream:
        names = stream.readline().rstrip("\n").split(",")
        content = np.loadtxt(stream, delimiter=",", ndmin=2)
    return dict(zip(names, content.T, strict=True))


def assert_whole(folder, study, evaluate=quick):
    """Every row is there once, in order, with what the evaluation says."""
    found = table(folder / "results.csv")
    assert tuple(found) == study.columns
    np.testing.assert_array_equal(found["row"], np.arange(study.samples))
    values = study.values()
    for name, column in zip(study.parameter_names, values.T, strict=True):
        np.testing.assert_allclose(found[name], column, rtol=1e-11)
    expected = evaluate(study, values, 0).columns
    for name in study.result_columns:
        # which samples are in a batch moves what is below the accuracy of the evaluation
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-6, err_msg=name)
    assert not (folder / "parts").exists()
    assert json.loads((folder / "study.json").read_text())["finished"]


# ---------------------------------------------------------------- what a run writes
def test_a_run_and_its_results(tmp_path):
    study, folder, counts = loaded(tmp_path, samples="50", controllers=TWO), output(tmp_path), []
    run = lbt.studies.run_study(study, folder, progress=counts.append)
    assert (run.samples, run.computed, run.failures, run.retry) == (50, 50, 0, 0)
    assert sum(counts) == 50
    assert_whole(folder, study, lbt.studies.evaluate_samples)
    assert (folder / "failed.csv").read_text() == "row,controller,error\n"
    assert lbt.load_gain(folder / "a.fits").method == "kalman"
    text = (folder / "results.csv").read_text()
    assert text.splitlines()[0] == ",".join(study.columns)
    assert text.splitlines()[7].startswith("6,")


def test_a_finished_study_is_not_run_again(tmp_path):
    study, folder, counts = loaded(tmp_path), output(tmp_path), []
    lbt.studies.run_study(study, folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    again = lbt.studies.run_study(study, folder, evaluate=None, progress=counts.append)
    assert (again.computed, sum(counts)) == (0, 16)
    seen = []
    lbt.studies.run_study(study, folder, evaluate=None, whole=seen.append)
    assert not seen[0].new
    assert seen[0].computing_s == json.loads(before["study.json"])["computing_seconds"] > 0
    np.testing.assert_array_equal(seen[0].columns["row"], np.arange(16))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_failures_are_listed_and_their_rows_are_there(tmp_path):
    study = loaded(
        tmp_path,
        samples="8",
        controllers="{a: {design: integrator, gain: 0.3}, tight: {design: integrator, gain: 0.7, "
        "for: sample}}",
        parameters="{loop.delay_frames: {list: [2, 4]}}",
    )
    folder = output(tmp_path)
    run = lbt.studies.run_study(study, folder)
    found = table(folder / "results.csv")
    assert_whole(folder, study, lbt.studies.evaluate_samples)
    noisy = np.flatnonzero(found["loop.delay_frames"] == 4)
    lines = (folder / "failed.csv").read_text().splitlines()[1:]
    assert [line.split(",")[:2] for line in lines] == [[str(row), "tight"] for row in noisy]
    assert all("failed its certificate" in line for line in lines)
    assert (run.failures, run.retry) == (4, 0)
    assert np.all(np.isnan(found["tight.strehl"][noisy]))
    assert not np.any(np.isnan(found["a.strehl"]))


@pytest.mark.usefixtures("small_batches")
def test_it_goes_on_where_it_was_whatever_the_batches(tmp_path):
    study, folder = loaded(tmp_path, samples="100"), output(tmp_path)
    seen = []

    def stops(study, values, start):
        seen.append((start, start + len(values)))
        if len(seen) == 4:
            raise KeyboardInterrupt
        return quick(study, values, start)

    with pytest.raises(KeyboardInterrupt):
        lbt.studies.run_study(study, folder, evaluate=stops)
    parts = [(part.start, part.stop) for part in list_parts(folder)]
    assert parts == seen[:3]
    list_parts(folder)[1].path.unlink()  # a hole
    seen.clear()

    def watches(study, values, start):
        seen.append((start, start + len(values)))
        return quick(study, values, start)

    counts = []
    run = lbt.studies.run_study(study, folder, evaluate=watches, progress=counts.append)
    kept = parts[0][1] + parts[2][1] - parts[2][0]
    assert (run.computed, counts[0], sum(counts)) == (100 - kept, kept, 100)
    assert sum(stop - start for start, stop in seen) == run.computed
    assert_whole(folder, study)


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


def test_missing_rows(tmp_path):
    from lbt_synth.studies.study.store import Part

    parts = [Part(start=a, stop=b, path=tmp_path) for a, b in [(2, 4), (4, 6), (9, 10)]]
    assert missing_rows(parts, 12) == [(0, 2), (6, 9), (10, 12)]
    assert missing_rows([], 5) == [(0, 5)]
    assert missing_rows(parts[:2], 6) == [(0, 2)]


# ---------------------------------------------------------------- what is refused
@pytest.mark.usefixtures("small_batches")
def test_other_studies_and_damage_are_refused(tmp_path):
    study, folder = loaded(tmp_path, samples="60", controllers=TWO), output(tmp_path)

    def stops(study, values, start):
        if start >= 40:
            raise KeyboardInterrupt
        return quick(study, values, start)

    with pytest.raises(KeyboardInterrupt):
        lbt.studies.run_study(study, folder, evaluate=stops)
    other = loaded(tmp_path, samples="60", controllers=TWO, seed="8")
    with pytest.raises(OutputError, match="is of another study"):
        lbt.studies.run_study(other, folder)
    with pytest.raises(OutputError, match="is of another study"):
        lbt.studies.load_study(other.source, directory=folder)
    with pytest.raises(OutputError, match="is of another study"):
        lbt.studies.replay_row(other, folder, 0)
    manifest = (folder / "study.json").read_text()
    (folder / "study.json").write_text(
        manifest.replace(lbt.__version__, "0.0.1").replace(study.digest, "0")
    )
    with pytest.raises(OutputError, match=r"was made by lbt_synth 0\.0\.1; this is"):
        lbt.studies.run_study(study, folder)
    (folder / "study.json").write_text("{}")
    with pytest.raises(OutputError, match="no manifest of a study"):
        lbt.studies.run_study(study, folder)
    (folder / "study.json").write_text(
        json.dumps({"schema": "lbt_synth study", "schema_version": 1})
    )
    with pytest.raises(OutputError, match="no manifest of a study"):
        lbt.studies.run_study(study, folder)
    (folder / "study.json").write_text("{")
    with pytest.raises(OutputError, match="cannot read"):
        lbt.studies.run_study(study, folder)
    (folder / "study.json").unlink()
    with pytest.raises(OutputError, match=r"parts of a study without its study\.json"):
        lbt.studies.run_study(study, folder)
    (folder / "study.json").write_text(manifest)
    part = list_parts(folder)[0].path
    content = part.read_bytes()
    for damage in (content[:-30], content[:200] + b"x" + content[201:], b""):
        part.write_bytes(damage)
        with pytest.raises(OutputError, match="is damaged. Delete it"):
            lbt.studies.run_study(study, folder)
    part.write_bytes(content)
    twin = part.with_name("0000000003-0000000005.npz")
    twin.write_bytes(content)
    with pytest.raises(OutputError, match="has rows that are in"):
        lbt.studies.run_study(study, folder)
    twin.unlink()
    design = (folder / "b.fits").read_bytes()
    lbt.save_gain(folder / "b.fits", lbt.integrator(study.config.hardware, gain=0.2))
    with pytest.raises(OutputError, match="is not the design that the study was begun with"):
        lbt.studies.run_study(study, folder)
    (folder / "b.fits").write_bytes(design)
    lbt.studies.run_study(study, folder, evaluate=quick)
    assert_whole(folder, study)


def test_designs_are_read_where_a_study_was_begun(tmp_path, monkeypatch):
    study, folder = loaded(tmp_path, controllers=TWO), output(tmp_path)
    lbt.studies.run_study(study, folder, evaluate=quick)
    monkeypatch.setattr("lbt_synth.studies.study.load.design_by_method", None)  # nothing is designed
    again = lbt.studies.load_study(study.source, directory=folder)
    for one, other in zip(study.controllers, again.controllers, strict=True):
        np.testing.assert_array_equal(one.design.controller.A, other.design.controller.A)
    assert again.digest == study.digest


def test_no_directory_and_inputs_in_the_way(tmp_path):
    study = loaded(tmp_path)
    with pytest.raises(OutputError, match="cannot write into"):
        lbt.studies.run_study(study, tmp_path / "nowhere")
    made = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.4)
    lbt.save_gain(tmp_path / "b.fits", made)
    study = loaded(tmp_path, controllers="{a: {file: b.fits}, b: {design: kalman}}")
    with pytest.raises(OutputError, match="must not replace the input"):
        lbt.studies.run_study(study, tmp_path)


def test_files_of_others_are_not_replaced(tmp_path):
    study, folder = loaded(tmp_path), output(tmp_path)
    for name in ("slow.fits", "results.csv", "summary.html", "summary.pdf"):
        (folder / name).write_text("mine")
        with pytest.raises(OutputError, match=f"{name} is of no study that was begun there"):
            lbt.studies.run_study(study, folder, evaluate=quick)
        assert [path.name for path in folder.iterdir() if path.name != ".lock"] == [name]
        (folder / name).unlink()


def test_killed_before_the_designs_were_written(tmp_path, monkeypatch):
    study, folder = loaded(tmp_path, controllers=TWO), output(tmp_path)

    def interrupted(path, design):
        if path.name == "b.fits":
            raise KeyboardInterrupt
        return lbt.save_gain(path, design)

    with monkeypatch.context() as patch:
        patch.setattr("lbt_synth.studies.study.store.save_gain", interrupted)
        with pytest.raises(KeyboardInterrupt):
            lbt.studies.run_study(study, folder, evaluate=quick)
    assert (folder / "a.fits").exists()
    assert not (folder / "b.fits").exists()
    again = lbt.studies.load_study(study.source, directory=folder)
    lbt.studies.run_study(again, folder, evaluate=quick)
    assert_whole(folder, study)
    assert set(json.loads((folder / "study.json").read_text())["designs"]) == {"a", "b"}


def test_what_a_killed_process_had_begun_to_write_is_removed(tmp_path):
    study, folder = loaded(tmp_path), output(tmp_path)
    (folder / "parts").mkdir()
    begun = [
        folder / "parts" / ".0000000004-0000000008.npz.abcd_123",
        folder / ".results.csv.abcd_123",
        folder / ".summary.html.abcd_123",
        folder / ".slow.fits.abcd_123",
    ]
    for path in begun:
        path.write_bytes(b"half")
    (folder / ".mine.csv.abcd_123").write_bytes(b"whole")
    lbt.studies.run_study(study, folder, evaluate=quick)
    assert_whole(folder, study)
    assert not any(path.exists() for path in begun)
    assert (folder / ".mine.csv.abcd_123").exists()


def test_jobs_without_number(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 10)
    with pytest.raises(ProblemError, match="jobs must be at most 80 on this machine; got 81"):
        lbt.studies.run_study(loaded(tmp_path), output(tmp_path), jobs=81)


def test_parquet_without_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow.parquet", None)
    study = loaded(tmp_path, results="parquet")
    with pytest.raises(MissingExtraError, match=r'pip install "lbt-synth\[parquet\]"'):
        lbt.studies.run_study(study, output(tmp_path))


def wrong(study, values, start):
    return {"a": 1}


def short(study, values, start):
    return quick(study, values[:-1], start)


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
        lbt.studies.run_study(loaded(tmp_path), output(tmp_path), evaluate=evaluate)


# ---------------------------------------------------------------- executors
def test_any_executor(tmp_path):
    study = loaded(tmp_path, samples="300")
    with ThreadPoolExecutor(3) as pool:
        lbt.studies.run_study(study, folder := output(tmp_path), executor=pool, evaluate=quick)
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
    study, folder = loaded(tmp_path, samples="300"), output(tmp_path)
    Breaks.calls, Breaks.kind = 0, kind
    with Breaks(1) as pool, pytest.raises(NumericalError, match=message):
        lbt.studies.run_study(study, folder, executor=pool, evaluate=quick)
    assert 1 <= len(list_parts(folder)) <= 3
    lbt.studies.run_study(study, folder, evaluate=quick)
    assert_whole(folder, study)


# ---------------------------------------------------------------- processes that die
def dies(study, values, start):
    """Row 3 always ends its process, row 9 does once."""
    rows = range(start, start + len(values))
    once = Path(os.environ["STUDY_DIED"])
    if 9 in rows and not once.exists():
        once.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    if 3 in rows and os.environ.get("STUDY_POISON"):
        os._exit(7)
    return quick(study, values, start)


@pytest.mark.usefixtures("small_batches")
def test_processes_that_die(tmp_path, monkeypatch):
    monkeypatch.setenv("STUDY_DIED", str(tmp_path / "died"))
    monkeypatch.setenv("STUDY_POISON", "1")
    study, folder = loaded(tmp_path, samples="10"), output(tmp_path)
    run = lbt.studies.run_study(study, folder, jobs=2, evaluate=dies)
    assert (tmp_path / "died").exists()
    assert (run.computed, run.failures, run.retry) == (10, 1, 1)
    found = table(folder / "results.csv")
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
    study = loaded(tmp_path, samples="400")
    with pytest.raises(NumericalError, match="1 times one after the other a process ended"):
        lbt.studies.run_study(study, output(tmp_path), jobs=2, evaluate=always_dies)


# ---------------------------------------------------------------- the disk
@pytest.mark.usefixtures("small_batches")
@pytest.mark.parametrize("calls", [1, 5, 9])
def test_a_full_disk(tmp_path, monkeypatch, calls):
    """The manifest and the design, parts, the results: whatever cannot be written."""
    study, folder = loaded(tmp_path, samples="60"), output(tmp_path)
    left, sync = [calls], os.fsync

    def full(handle):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match="No space left on device.*its free space"):
            lbt.studies.run_study(study, folder, evaluate=quick)
    assert not list(folder.rglob(".*.*"))  # nothing half-written
    lbt.studies.run_study(study, folder, evaluate=quick)
    assert_whole(folder, study)


# ---------------------------------------------------------------- a row again
REPLAYED = {
    "exact": {"evaluation": "exact"},
    "simulation": {"evaluation": "simulation"},
}


@pytest.mark.parametrize("evaluation", ["exact", "simulation"])
@pytest.mark.parametrize("turbulence", ["ar1", "ar2"])
def test_a_row_is_replayed(tmp_path, evaluation, turbulence):
    base = LBT_TEXT.replace("kind: ar1", f"kind: {turbulence}").replace(
        "turbulence: frozen_flow", "turbulence: model"
    )
    base = base.replace("frames: 8000", "frames: 300").replace("cases: 4", "cases: 2")
    study = loaded(
        tmp_path,
        base=base,
        evaluation=evaluation,
        samples="4",
        controllers="{a: {design: integrator, gain: 0.4}, told: {design: kalman, for: sample}}",
        parameters="{atmosphere.seeing_arcsec: {uniform: [0.6, 1]}, error.delay_frames: {uniform: "
        "[0.1, 0.3]}, error.noise_factor: {uniform: [1.2, 1.6]}, truth.sensor_gain: 0.8}",
    )
    folder = output(tmp_path)
    lbt.studies.run_study(study, folder)
    again = lbt.studies.replay_row(study, folder, 2)
    assert [path.name for path in again.files] == ["row_2.yaml", "row_2_told.fits"]
    assert set(again.fresh) == set(again.stored) == set(study.result_columns)
    for name, value in again.stored.items():
        assert again.fresh[name] == pytest.approx(value, rel=1e-6)
    real = lbt.load_config(folder / "row_2.yaml")
    assert real.hardware.delay_frames == 2 + again.parameters["error.delay_frames"]
    text = (folder / "row_2.yaml").read_text()
    assert "designs assume 2 (error.delay_frames)" in text
    assert "(error.noise_factor)" in text
    for name, path in (("a", folder / "a.fits"), ("told", folder / "row_2_told.fits")):
        design = lbt.load_gain(path)
        loop = lbt.close_loop(real.hardware, design.controller, sensor_gain=real.truth.sensor_gain)
        if evaluation == "exact":
            found = lbt.strehl(lbt.residual_budget(loop, real.truth), real.imaging)
        else:
            section = real.settings.simulation
            found = (
                lbt.simulate(
                    design.controller,
                    real.truth,
                    hardware=real.hardware,
                    frames=300,
                    cases=2,
                    seed=section.seed,
                    settle_frames=section.settle_frames,
                )
                .strehl(real.imaging)
                .mean()
            )
        assert found == pytest.approx(again.fresh[f"{name}.strehl"], rel=1e-9)


@pytest.mark.usefixtures("small_batches")
def test_a_row_of_an_unfinished_study(tmp_path):
    study, folder = loaded(tmp_path, samples="60"), output(tmp_path)
    assert lbt.studies.replay_row(study, folder, 3).stored == {}

    def stops(study, values, start):
        if start >= 40:
            raise KeyboardInterrupt
        return quick(study, values, start)

    with pytest.raises(KeyboardInterrupt):
        lbt.studies.run_study(study, folder, evaluate=stops)
    last = list_parts(folder)[-1].stop - 1
    stored = lbt.studies.replay_row(study, folder, last).stored
    values = study.values(last, last + 1)
    assert stored["slow.strehl"] == quick(study, values, last).columns["slow.strehl"][0]
    assert lbt.studies.replay_row(study, folder, 59).stored == {}
    with pytest.raises(ProblemError, match="rows 0 to 59; got row 60"):
        lbt.studies.replay_row(study, folder, 60)


def test_a_row_whose_design_fails(tmp_path):
    study = loaded(
        tmp_path,
        samples="2",
        controllers="{tight: {design: integrator, gain: 0.7, for: sample}}",
        parameters="{loop.delay_frames: {list: [4, 5]}}",
    )
    again = lbt.studies.replay_row(study, output(tmp_path), 1)
    assert "failed its certificate" in again.failures[0].error
    assert [path.name for path in again.files] == ["row_1.yaml"]


def test_a_row_without_noise(tmp_path):
    study, folder = loaded(tmp_path, parameters="{error.noise_factor: 0}"), output(tmp_path)
    again = lbt.studies.replay_row(study, folder, 1)
    assert again.fresh["slow.noise_nm"] == 0
    assert again.fresh["slow.strehl"] > 0.1
    assert again.files == ()
    assert "row 1 has no noise, which no configuration takes" in again.unwritten


def test_a_table_of_results_that_was_changed(tmp_path):
    study, folder = loaded(tmp_path), output(tmp_path)
    lbt.studies.run_study(study, folder, evaluate=quick)
    lines = (folder / "results.csv").read_text().splitlines()
    (folder / "results.csv").write_text("\n".join(lines[:8]) + "\n")
    with pytest.raises(OutputError, match="is not as the study wrote it"):
        lbt.studies.replay_row(study, folder, 9)
    (folder / "results.csv").write_text("\n".join([*lines[:8], lines[8].replace("7", "8")]))
    with pytest.raises(OutputError, match="is not as the study wrote it"):
        lbt.studies.run_study(study, folder, evaluate=quick)
    (folder / "results.csv").unlink()
    assert lbt.studies.run_study(study, folder, evaluate=quick).computed == 16
    (folder / "failed.csv").write_text("row,controller,error\n3,slow,made up\n")
    with pytest.raises(OutputError, match=r"failed\.csv is not as the study wrote it"):
        lbt.studies.run_study(study, folder, evaluate=quick)
    (folder / "failed.csv").unlink()
    lbt.studies.run_study(study, folder, evaluate=quick)
    assert_whole(folder, study)


# ---------------------------------------------------------------- what it will cost
def test_an_estimate(tmp_path):
    study = loaded(tmp_path, samples="5000")

    def slow(study, values, start):
        time.sleep(1e-3 * len(values))
        return quick(study, values, start)

    cost = lbt.studies.estimate_study(study, workers=1, evaluate=slow)
    assert 4 < cost.seconds < 9
    assert cost.measured_rows >= 1000
    far = lbt.studies.estimate_study(study, workers=100, local=False, evaluate=slow)
    assert far.seconds < 0.09
    with pytest.raises(ProblemError, match="workers must be at least 1"):
        lbt.studies.estimate_study(study, workers=0)


# ---------------------------------------------------------------- optional packages
@pytest.mark.e2e
def test_parquet(tmp_path):
    import pyarrow.parquet as pq

    study = loaded(tmp_path, samples="70", results="parquet", controllers=TWO)
    folder = output(tmp_path)
    run = lbt.studies.run_study(study, folder, evaluate=quick)
    assert run.results.name == "results.parquet"
    found = pq.read_table(run.results)
    assert tuple(found.column_names) == study.columns
    assert str(found.schema.field("row").type) == "int64"
    assert found["row"].to_pylist() == list(range(70))
    expected = quick(study, study.values(), 0).columns
    for name in study.result_columns:
        assert found[name].to_pylist() == expected[name].tolist()  # all digits
    assert lbt.studies.replay_row(study, folder, 69).stored["a.strehl"] == expected["a.strehl"][69]
    assert lbt.studies.run_study(study, folder, evaluate=None).computed == 0
