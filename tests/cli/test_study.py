"""The command study: run, killed, interrupted, replayed, on Dask."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.commands import refuse_commands, run, run_done, run_json
from support.studies import TWO, assert_whole, evaluate_quickly, part_rows, read_table, study_file

import lbt_synth as lbt
from lbt_synth.errors import NumericalError
from lbt_synth.storage.executors import connect_cluster
from lbt_synth.studies.study.run import evaluate_samples


def wait_for(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


PARAMETERS = (
    "{'truth.vibrations[0].rms_nm': {uniform: [100, 900]}, truth.sensor_gain: {uniform: [0.5, 1]}, "
    "error.noise_factor: 1.5}"
)


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "lbt_synth.cli.main", "study", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background job ignores interrupts, and so would what it starts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def children(pid):
    with contextlib.suppress(OSError):
        return [
            int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        ]
    return []


def test_the_command(tmp_path, capsys):
    path, folder = (
        study_file(tmp_path, samples="40", controllers=TWO, parameters=PARAMETERS),
        tmp_path / "out",
    )
    words = ("study", path, "-o", folder)
    out = run_done(capsys, *words, "--verbose")
    for text in ("50th percentile", "unstable", "failed", "Worst samples of b", "sensor_gain"):
        assert text in out
    assert "40 of 40 samples computed in" in out
    study, page = lbt.studies.load_study(path), folder / "summary.html"
    assert_whole(folder, study, evaluate_samples)
    assert b"<svg" in page.read_bytes()
    page.write_text("changed")
    data = run_json(capsys, *words)
    assert (data["computed"], data["failures"]) == (0, 0)
    table = read_table(folder / "results.csv")
    for name, controller in zip("ab", data["statistics"]["controllers"], strict=True):
        assert controller["mean"] == pytest.approx(np.nanmean(table[f"{name}.strehl"]), rel=1e-7)
    assert page.read_text() == "changed"
    page.unlink()
    out = run_done(capsys, *words, "--verbose")
    assert "is finished: 40 samples in results.csv; none computed" in out
    assert f"written: {page}" in out
    assert f"unchanged: {folder / 'results.csv'}" in out
    assert b"computing time, of all processes together" in page.read_bytes()
    again = run_json(capsys, *words, "--row", "7")
    assert again["fresh"]["a.strehl"] == pytest.approx(again["stored"]["a.strehl"], rel=1e-6)
    assert (folder / "row_7.yaml").exists()
    rows = [(f"study {path} -o {folder} --row 40", "rows 0 to 39; got row 40")]
    refuse_commands(capsys, rows)


def test_dask_without_its_package(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    path = study_file(tmp_path, samples="4")
    words = f"study {path} -o {tmp_path}/out --dask tcp://localhost:8786"
    refuse_commands(capsys, [(words, 'pip install "lbt-synth[dask]"')])
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The results of a study that nothing disturbs."""
    folder = tmp_path_factory.mktemp("undisturbed")
    study = lbt.studies.load_study(study_file(folder, samples="600", parameters=PARAMETERS))
    done = lbt.studies.run_study(study, folder)
    assert (done.computed, done.failures) == (600, ())
    return read_table(done.results)


def test_killed_it_goes_on_where_it_was(tmp_path, capsys, undisturbed):
    path = study_file(tmp_path, samples="600", parameters=PARAMETERS)
    folder = tmp_path / "out"
    first = started(path, "-o", folder, "--jobs", "2")
    wait_for(lambda: len(part_rows(folder)) >= 2, seconds=120)
    workers = children(first.pid)
    first.send_signal(signal.SIGKILL)
    first.communicate()
    kept = part_rows(folder)
    assert sum(stop - start for start, stop in kept) < 600
    wait_for(lambda: not any(alive(pid) for pid in workers))  # none is left behind
    out = run_done(capsys, "study", path, "-o", folder)
    missing = 600 - sum(stop - start for start, stop in kept)
    assert f"{missing} of 600 samples computed" in out
    found = read_table(folder / "results.csv")
    assert found["row"].tolist() == list(range(600))
    for name, column in undisturbed.items():
        np.testing.assert_allclose(found[name], column, rtol=1e-6, err_msg=name)


def test_an_interrupt_ends_it_at_once(tmp_path):
    path = study_file(tmp_path, samples="300000", parameters=PARAMETERS)
    folder = tmp_path / "out"
    first = started(path, "-o", folder, "--jobs", "2")
    wait_for(lambda: len(part_rows(folder)) >= 2, seconds=120)
    workers = children(first.pid)
    before = time.monotonic()
    first.send_signal(signal.SIGINT)
    out, error = first.communicate(timeout=60)
    assert time.monotonic() - before < 30
    assert (first.returncode, out) == (130, "")
    kept = f"lbt-synth: what is finished is kept in {folder}; start it again to continue"
    assert error.splitlines() == [kept, "lbt-synth: interrupted"]
    wait_for(lambda: not any(alive(pid) for pid in workers))
    assert len(part_rows(folder)) >= 2
    assert not list(folder.rglob(".*.npz*"))


@pytest.mark.e2e
def test_the_command_on_dask(tmp_path, capsys, cluster, monkeypatch):
    path = study_file(tmp_path, samples="40", parameters=PARAMETERS)
    address = cluster.scheduler_address
    arguments = ("study", path, "-o", tmp_path / "out", "--dask", address)
    with monkeypatch.context() as patch:
        patch.setattr(lbt, "__version__", "9.9.9")
        status, _, error = run(capsys, *arguments)
        assert status == 2
        assert "all workers must have lbt_synth 9.9.9, as here" in error
    assert not (tmp_path / "out").exists()
    status, _, error = run(capsys, *arguments)
    assert status == 0, error
    assert_whole(tmp_path / "out", lbt.studies.load_study(path), evaluate_samples)


@pytest.mark.e2e
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense://x", "127.0.0.1:notaport", ""])
def test_no_scheduler(tmp_path, capsys, address, monkeypatch):
    monkeypatch.setattr("lbt_synth.storage.executors._TIMEOUT_S", 1)
    path = study_file(tmp_path, samples="4", parameters=PARAMETERS)
    before = time.monotonic()
    status, _, error = run(capsys, "study", path, "-o", tmp_path / "out", "--dask", address)
    assert status == 2
    assert time.monotonic() - before < 10
    assert "no Dask scheduler answers at" in error
    assert error.count("\n") == 1


@pytest.mark.e2e
def test_a_scheduler_without_workers(tmp_path, capsys, monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setattr("lbt_synth.storage.executors._TIMEOUT_S", 1)
    path = study_file(tmp_path, samples="4", parameters=PARAMETERS)
    with LocalCluster(n_workers=0, dashboard_address=":0") as empty:
        status, _, error = run(
            capsys, "study", path, "-o", tmp_path / "out", "--dask", empty.scheduler_address
        )
    assert status == 2
    assert "has no workers; start some with" in error


def kills_its_worker(study, values, start):
    """The first process that gets rows from 30 on ends; the file that it makes stops the others."""
    if start >= 30:
        with contextlib.suppress(FileExistsError):
            Path(os.environ["STUDY_DIED"]).touch(exist_ok=False)
            time.sleep(0.5)  # so that the first rows are written
            os.kill(os.getpid(), signal.SIGKILL)
    return evaluate_quickly(study, values, start)


@pytest.mark.e2e
def test_a_worker_killed_on_dask(tmp_path, monkeypatch):
    """Two workers, of which one is killed: the study is started again, and nothing is lost."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("STUDY_DIED", str(tmp_path / "died"))
    study = lbt.studies.load_study(study_file(tmp_path, samples="60", parameters=PARAMETERS))
    folder = tmp_path / "out"
    folder.mkdir()
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**options) as cluster:
        cluster.scheduler.allowed_failures = 0  # one death is enough
        with connect_cluster(cluster.scheduler_address) as (executor, workers):
            assert workers == 2
            run = partial(
                lbt.studies.run_study, study, folder, executor=executor, workers=workers,
                evaluate=kills_its_worker,
            )  # fmt: skip
            with pytest.raises(NumericalError, match="start the study again"):
                run()
            kept = sum(stop - start for start, stop in part_rows(folder))
            assert 0 < kept < 60
            again = run()
    assert (again.computed, again.failures) == (60 - kept, ())
    assert_whole(folder, study)
