"""The Dask cluster of a study: workers that die, and its log."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import threading
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


ANSWERS = {
    "silent": b"",
    "a web server": b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n",
    "a shell": b"SSH-2.0-OpenSSH_9.2p1\r\n",
    "endless": b"\xff" * 64,
}


@pytest.mark.e2e
@pytest.mark.parametrize("who", ANSWERS)
def test_what_is_no_scheduler_is_refused_in_time(monkeypatch, who):
    pytest.importorskip("distributed")
    monkeypatch.setattr("lbt_synth.studies.study.cluster._TIMEOUT_S", 1)
    kept = []

    def answer():
        with contextlib.suppress(OSError):
            while True:
                kept.append(listener.accept()[0])
                kept[-1].sendall(ANSWERS[who])

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=answer, daemon=True).start()
        port = listener.getsockname()[1]
        with (
            pytest.raises(lbt.errors.ProblemError, match="no Dask scheduler answers at"),
            connect_cluster(f"tcp://127.0.0.1:{port}"),
        ):
            pass
        listener.shutdown(socket.SHUT_RDWR)
    for each in kept:
        each.close()
