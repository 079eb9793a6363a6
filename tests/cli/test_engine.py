"""A study on a Dask cluster."""

import contextlib
import os
import signal
import time
from functools import partial
from pathlib import Path

import pytest
from support.studies import assert_whole, evaluate_quickly, part_rows, study_file

import lbt_synth as lbt
from lbt_synth.cli.engine import connect_cluster
from lbt_synth.errors import NumericalError

PARAMETERS = (
    "{'truth.vibrations[0].rms_nm': {uniform: [100, 900]}, truth.sensor_gain: {uniform: [0.5, 1]}, "
    "error.noise_factor: 1.5}"
)


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
