"""The commands plot, report and explore: their files, their output, and their errors."""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from support.commands import hear_interruptions, refuse_commands, run, run_json
from support.configs import with_errors
from support.plants import LBT_YAML

import lbt_synth as lbt


def test_a_page_is_made_of_gain_files(tmp_path, capsys, monkeypatch, gains):
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(with_errors(LBT_YAML.read_text(), 0))
    data = run_json(capsys, "report", "small.yaml", *gains.values(), "-o", "r.html")
    assert data["files"] == ["r.html"]
    assert list(data["designs"]) == list(gains)
    kalman, design = data["designs"]["kalman"], lbt.load_gain(gains["kalman"])
    config = lbt.load_config("small.yaml")
    loop = lbt.close_loop(config.hardware, design.controller)
    assert kalman["residual_nm"] == pytest.approx(lbt.residual_budget(loop, config.truth).rms_nm)
    assert kalman["certified"] is True
    digest = hashlib.sha256(gains["kalman"].read_bytes()).hexdigest()
    assert data["sha256"]["kalman.fits"] == digest
    assert str(gains["kalman"].parent) not in Path("r.html").read_text()  # it names no directories


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
            out, error = process.communicate(timeout=60)
        finally:
            process.kill()  # else the test would wait for ever
    assert "<title>Explore lbt.yaml</title>" in text
    assert (process.returncode, error) == (0, "")
    assert json.loads(out) == {"url": url, "files": []}


def test_wrong_words_are_refused(capsys, tmp_path, monkeypatch, gains):
    monkeypatch.chdir(tmp_path)
    shutil.copy(LBT_YAML, "lbt.yaml")
    lbt.save_gain("FAST.fits", lbt.integrator(lbt.LoopHardware(frame_rate_hz=500), gain=0.3))
    fast = "must run at the configuration's 800 Hz; got a design for"
    rows = [
        ("report lbt.yaml GAIN -o x.pdf", "a page must end in .html; got 'x.pdf'"),
        ("report lbt.yaml GAIN -o x.html --title ", "--title must hold at least one letter"),
        ("report lbt.yaml GAIN GAIN -o x.html", "must have a name of its own"),
        ("report lbt.yaml FAST.fits -o x.html", fast),
        ("explore lbt.yaml --port 70000", "--port must be at most 65535"),
        (
            "explore lbt.yaml --origin a\x07b:8",
            "--origin must be HOST:PORT, as localhost:8080; got",
        ),
        ("explore lbt.yaml -o nowhere", "no directory nowhere"),
        ("explore lbt.yaml FAST.fits", fast),
    ]
    refuse_commands(capsys, rows, GAIN=gains["integrator"])
    assert not (tmp_path / "x.html").exists()


@pytest.mark.parametrize("view", ["bode", "nyquist", "nichols", "step", "sigma"])
def test_a_view_writes_its_figure_and_its_points(view, tmp_path, capsys, gains):
    figure, table = tmp_path / f"{view}.png", tmp_path / f"{view}.csv"
    files = (gains["kalman"], gains["integrator"])
    data = run_json(capsys, "plot", view, *files, "-o", figure, "-o", table)
    assert data["verdict"][0].startswith("kalman survives 0.47 frames more delay")
    assert figure.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    for curve in data["curves"]:
        place = curve["panel"], curve["name"]
        named = [row for row in rows if (row["panel"], row["curve"]) == place]
        assert {float(row["y"]) for row in named if row["y"]} >= {y for y in curve["y"] if y}
    names = {curve["name"].partition(":")[0] for curve in data["curves"]}
    assert names >= ({"loop"} if view == "nyquist" else {"kalman", "integrator"})


def test_points_of_a_loop_are_those_of_an_integrator(capsys, gains):
    data = run_json(capsys, "plot", "bode", gains["integrator"])
    gain, phase = (c for c in data["curves"] if c["name"].startswith("integrator"))
    z = np.exp(2j * np.pi * np.array(gain["x"]) / 800)
    expected = 0.5 * z**-2 / (1 - 1 / z)
    assert gain["y"] == pytest.approx(20 * np.log10(np.abs(expected)), abs=1e-6)
    assert np.exp(1j * np.radians(phase["y"])) == pytest.approx(expected / abs(expected), abs=1e-6)
    assert (gain["panel"], gain["heading"]) == ("loop gain [dB]", "frequency [Hz]")
    (row,) = run_json(capsys, "plot", "step", gains["integrator"])["steps"]
    assert row["overshoot_percent"] == pytest.approx(25.0)  # 1, 1, 0.5, 0, -0.25, -0.25, ...


def test_without_a_stable_loop_there_is_nothing_to_draw(tmp_path, capsys, gains):
    out = tmp_path / "bode.csv"
    words = ("plot", "bode", gains["integrator"], "--gain-factor", 3, "-o", out)
    status, _, error = run(capsys, *words)
    assert (status, out.exists()) == (1, False)
    assert "no loop is stable at 3 times the sensor gain" in error
