"""The command ``explore``: what it refuses before it serves, and how it begins and ends."""

import json
import signal
import socket
import subprocess
import sys
from urllib.request import urlopen

import pytest
from support.commands import hear_interruptions, run
from support.plants import LBT_YAML

import lbt_synth as lbt


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--port", "70000"), "--port must be at most 65535"),
        (("--origin", "http://a:8"), "--origin must be HOST:PORT, as localhost:8080; got"),
        (("--origin", "a\x07b:8"), "--origin must be HOST:PORT, as localhost:8080; got"),
        (("--origin", "a:123456"), "--origin must be HOST:PORT, as localhost:8080; got"),
        (("-o", "nowhere"), "no directory nowhere"),
        (("nothing.fits",), "nothing.fits"),
    ],
)
def test_wrong_words_are_refused(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    status, out, error = run(capsys, "explore", LBT_YAML, *words)
    assert (status, out) == (2, "")
    assert message in error
    assert error.count("\n") == 1


def test_a_design_for_another_loop_is_refused(capsys, tmp_path):
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=500), gain=0.3)
    lbt.save_gain(tmp_path / "slow.fits", design)
    status, _, error = run(capsys, "explore", LBT_YAML, tmp_path / "slow.fits")
    assert status == 2
    assert "slow must run at the configuration's 800 Hz" in error


@pytest.mark.parametrize(
    ("host", "message"),
    [
        ("localhost", "--port {port}: Address already in use"),
        ("no.such.host.invalid", "cannot serve at --host"),
        (64 * "a", "cannot serve at --host"),
    ],
)
def test_a_place_that_is_not_free_is_said(capsys, host, message):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        status, out, error = run(capsys, "explore", LBT_YAML, "--host", host, "--port", port)
    assert (status, out) == (2, "")
    assert message.format(port=port) in error
    assert error.count("\n") == 1


def test_it_serves_until_it_is_interrupted(tmp_path):
    words = ["explore", str(LBT_YAML), "--port", "0", "-o", str(tmp_path), "--json"]
    command = [sys.executable, "-m", "lbt_synth.cli.main", *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, preexec_fn=hear_interruptions, **pipes) as process:
        try:
            url = process.stderr.readline().split()[1]
            with urlopen(url) as page:
                text = page.read().decode()
        finally:
            process.send_signal(signal.SIGINT)
        try:
            out, error = process.communicate(timeout=20)
        finally:
            process.kill()  # else the test would wait for ever
    assert "<title>Explore lbt.yaml</title>" in text
    assert (process.returncode, error) == (0, "")
    assert json.loads(out) == {"url": url, "files": []}
