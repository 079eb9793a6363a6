"""The Dask cluster of a study: workers that die, and its log."""

from __future__ import annotations

import logging
import os
import signal
import time

import numpy as np
import pytest
from support.studies import assert_whole, evaluate_quickly, read_table, study_file

import lbt_synth as lbt
from lbt_synth.studies.study.cluster import connect_cluster

PARAMETERS = (
    "{'truth.vibrations[0].rms_nm': {uniform: [100, 900]}, truth.sensor_gain: {uniform: [0.5, 1]}, "
    "error.noise_factor: 1.5}"
)


def waits(study, values, start):
    time.sleep(0.02 * len(values))
    return evaluate_quickly(study, values, start)


@pytest.mark.e2e
def test_a_worker_killed_on_dask(tmp_path, cluster):
    from distributed import Client

    study = lbt.studies.load_study(study_file(tmp_path, samples="60", parameters=PARAMETERS))
    folder = tmp_path / "out"
    folder.mkdir()
    killed = []

    def kill(done):
        if not killed:
            victim = next(iter(client.run(os.getpid).values()))
            os.kill(victim, signal.SIGKILL)
            killed.append(victim)

    with Client(cluster, set_as_default=False) as client:
        result = lbt.studies.run_study(
            study,
            folder,
            executor=client.get_executor(pure=False),
            workers=2,
            evaluate=waits,
            progress=kill,
        )
    assert killed
    assert (result.computed, result.failures) == (60, 0)
    assert_whole(folder, study)


def poison(study, values, start):
    if start <= 4 < start + len(values):
        os._exit(5)
    return evaluate_quickly(study, values, start)


@pytest.mark.e2e
def test_a_row_that_kills_its_workers_on_dask(tmp_path, cluster, monkeypatch):
    from distributed import Client

    study = lbt.studies.load_study(study_file(tmp_path, samples="6", parameters=PARAMETERS))
    folder = tmp_path / "out"
    folder.mkdir()
    monkeypatch.setattr(cluster.scheduler, "allowed_failures", 0)  # one death is enough
    with Client(cluster, set_as_default=False) as client:
        result = lbt.studies.run_study(
            study, folder, executor=client.get_executor(pure=False), workers=2, evaluate=poison
        )
    assert (result.failures, result.retry) == (1, 1)
    found = read_table(folder / "results.csv")
    assert np.flatnonzero(np.isnan(found["slow.strehl"])).tolist() == [4]
    again = lbt.studies.run_study(study, folder, evaluate=evaluate_quickly)
    assert (again.computed, again.retry) == (1, 0)
    assert_whole(folder, study)


@pytest.mark.e2e
def test_dask_logs_no_tracebacks(capsys, cluster):
    """A scheduler that is gone is told by our error alone."""
    logger = logging.getLogger("distributed.client")
    with connect_cluster(cluster.scheduler_address):
        logger.error("a traceback")
        assert not logger.isEnabledFor(logging.ERROR)
    assert logger.isEnabledFor(logging.ERROR)
    assert "a traceback" not in capsys.readouterr().err
