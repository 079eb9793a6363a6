"""The command study: run, killed, interrupted, replayed, on Dask."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from support.commands import hear_interruptions, refuse_commands, run, run_done, run_json
from support.studies import (
    TWO,
    assert_whole,
    evaluate_quickly,
    make_folder,
    part_rows,
    read_table,
    study_file,
)

import lbt_synth as lbt
from lbt_synth.errors import NumericalError
from lbt_synth.storage.executors import connect_cluster
from lbt_synth.studies.study.run import evaluate_samples

PARAMETERS = (
    "{'truth.vibrations[0].rms_nm': {uniform: [100, 900]}, truth.sensor_gain: {uniform: [0.5, 1]}, "
    "error.noise_factor: 1.5}"
)


def wait_for(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


def alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def stopped(path, folder, number):
    """Stop a study with a signal when it has written two parts; return status and streams."""
    command = [sys.executable, "-m", "lbt_synth", "study", path, "-o", folder, "--jobs", "2"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    first = subprocess.Popen(command, preexec_fn=hear_interruptions, **pipes)
    wait_for(lambda: len(part_rows(folder)) >= 2)
    workers = Path(f"/proc/{first.pid}/task/{first.pid}/children").read_text().split()
    first.send_signal(number)
    out, error = first.communicate(timeout=30)
    wait_for(lambda: not any(map(alive, workers)), 30)  # none is left behind
    return first.returncode, out, error


def test_the_command(tmp_path, capsys):
    path = study_file(tmp_path, samples="40", controllers=TWO, parameters=PARAMETERS)
    folder = tmp_path / "out"
    words = ("study", path, "-o", folder)
    out = run_done(capsys, *words, "--verbose")
    words_of_tables = ("50th percentile", "unstable", "failed", "Worst samples of b", "sensor_gain")
    for text in (*words_of_tables, "40 of 40 samples computed in"):
        assert text in out
    study, page = lbt.studies.load_study(path), folder / "summary.html"
    assert_whole(folder, study, evaluate_samples)
    assert b"<svg" in page.read_bytes()
    page.write_text("changed")
    data = run_json(capsys, *words)
    assert (data["computed"], data["failures"], page.read_text()) == (0, 0, "changed")
    table = read_table(folder / "results.csv")
    means = [controller["mean"] for controller in data["statistics"]["controllers"]]
    expected = [np.nanmean(table[f"{name}.strehl"]) for name in "ab"]
    assert means == pytest.approx(expected, rel=1e-7)
    page.unlink()
    out = run_done(capsys, *words, "--verbose")
    finished = "is finished: 40 samples in results.csv; none computed"
    for text in (finished, f"written: {page}", f"unchanged: {folder / 'results.csv'}"):
        assert text in out
    assert b"computing time, of all processes together" in page.read_bytes()
    again = run_json(capsys, *words, "--row", "7")
    assert again["fresh"]["a.strehl"] == pytest.approx(again["stored"]["a.strehl"], rel=1e-6)
    assert (folder / "row_7.yaml").exists()
    shown = run_done(capsys, *words, "--row", "7", "--unit", "mas", "--verbose")
    (mas,) = re.findall(r"a.residual_mas +\S+ +(\S+)", shown)
    nm = lbt.models.nm_per_mas(8.22) * float(mas)
    assert nm == pytest.approx(again["fresh"]["a.residual_nm"], rel=1e-5)
    rows = [(f"study {path} -o {folder} --row 40", "rows 0 to 39; got row 40")]
    refuse_commands(capsys, rows)


def test_killed_it_goes_on_where_it_was(tmp_path, capsys):
    path, folder = study_file(tmp_path, samples="600", parameters=PARAMETERS), tmp_path / "out"
    stopped(path, folder, signal.SIGKILL)
    missing = 600 - sum(stop - start for start, stop in part_rows(folder))
    assert missing > 0
    out = run_done(capsys, "study", path, "-o", folder)
    assert f"{missing} of 600 samples computed" in out
    assert_whole(folder, lbt.studies.load_study(path), evaluate_samples)


def test_an_interrupt_ends_it_at_once(tmp_path):
    path, folder = study_file(tmp_path, samples="300000", parameters=PARAMETERS), tmp_path / "out"
    status, out, error = stopped(path, folder, signal.SIGINT)
    kept = f"lbt-synth: what is finished is kept in {folder}; start it again to continue"
    assert (status, out) == (130, "")
    assert error.splitlines() == [kept, "lbt-synth: interrupted"]
    assert len(part_rows(folder)) >= 2
    assert not list(folder.rglob(".*.npz*"))


def refuse_dask(capsys, folder, address, words):
    path = study_file(folder, samples="4", parameters=PARAMETERS)
    status, _, error = run(capsys, "study", path, "-o", folder / "out", "--dask", address)
    assert (status, words in error, (folder / "out").exists()) == (2, True, False), error
    return error


def test_dask_without_its_package(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    refuse_dask(capsys, tmp_path, "tcp://localhost:8786", 'pip install "lbt-synth[dask]"')


@pytest.mark.e2e
def test_the_command_on_dask(tmp_path, capsys, cluster, monkeypatch):
    address = cluster.scheduler_address
    with monkeypatch.context() as patch:
        patch.setattr(lbt, "__version__", "9.9.9")
        refuse_dask(capsys, tmp_path, address, "all workers must have lbt_synth 9.9.9, as here")
    path = study_file(tmp_path, samples="40", parameters=PARAMETERS)
    status, _, error = run(capsys, "study", path, "-o", tmp_path / "out", "--dask", address)
    assert status == 0, error
    assert_whole(tmp_path / "out", lbt.studies.load_study(path), evaluate_samples)


@pytest.mark.e2e
def test_no_scheduler_and_one_without_workers(tmp_path, capsys, monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setattr("lbt_synth.storage.executors._TIMEOUT_S", 1)
    before = time.monotonic()
    for address in ("tcp://127.0.0.1:9", "nonsense://x", "127.0.0.1:notaport", ""):
        error = refuse_dask(capsys, tmp_path, address, "no Dask scheduler answers at")
        assert error.count("\n") == 1
    assert time.monotonic() - before < 40
    with LocalCluster(n_workers=0, dashboard_address=":0") as empty:
        address = empty.scheduler_address
        refuse_dask(capsys, tmp_path, address, "has no workers; start some with")


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
    monkeypatch.setenv("STUDY_DIED", str(tmp_path / "died"))
    study = lbt.studies.load_study(study_file(tmp_path, samples="60", parameters=PARAMETERS))
    folder, how = make_folder(tmp_path), {"n_workers": 2, "threads_per_worker": 1}
    with pytest.importorskip("distributed").LocalCluster(dashboard_address=":0", **how) as two:
        two.scheduler.allowed_failures = 0  # one death is enough
        with connect_cluster(two.scheduler_address) as (executor, workers):
            options = {"executor": executor, "workers": workers, "evaluate": kills_its_worker}
            with pytest.raises(NumericalError, match="start the study again"):
                lbt.studies.run_study(study, folder, **options)
            kept = sum(stop - start for start, stop in part_rows(folder))
            again = lbt.studies.run_study(study, folder, **options)
    assert 0 < kept < 60
    assert (again.computed, again.failures) == (60 - kept, ())
    assert_whole(folder, study)
