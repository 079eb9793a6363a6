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
from support.commands import hear_interruptions, run
from support.plants import LBT_YAML

import lbt_synth as lbt


def test_command(small_config, small_designs, capsys, monkeypatch):
    monkeypatch.chdir(small_config.source.parent)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    for name in ("kalman", "slow"):
        lbt.save_gain(f"{name}.fits", small_designs[name])
    command = ("report", "small.yaml", "kalman.fits", "slow.fits")
    status, out, error = run(capsys, *command, "-o", "r.html", "--json")
    assert (status, error) == (0, "")
    data = json.loads(out)
    assert data["files"] == ["r.html"]
    assert list(data["designs"]) == ["kalman", "slow"]
    kalman = data["designs"]["kalman"]
    loop = lbt.close_loop(small_config.hardware, small_designs["kalman"].controller)
    budget = lbt.residual_budget(loop, small_config.truth)
    assert kalman["residual_nm"] == pytest.approx(budget.rms_nm)
    assert kalman["certified"] is True
    assert (
        data["sha256"]["kalman.fits"]
        == hashlib.sha256(Path("kalman.fits").read_bytes()).hexdigest()
    )
    assert data["made"] == "2023-11-14 22:13:20 UTC"
    first = Path("r.html").read_bytes()
    status, out, _ = run(capsys, *command, "-o", "r.html")
    assert status == 0
    assert out.startswith("kalman leaves ")
    assert "written: r.html" in out
    assert Path("r.html").read_bytes() == first


def test_gain_files_have_names_of_their_own(small_config, small_designs, tmp_path, capsys):
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        lbt.save_gain(tmp_path / place / "k.fits", small_designs["slow"])
    files, page = [tmp_path / place / "k.fits" for place in ("a", "b")], tmp_path / "r.html"
    status, _, error = run(capsys, "report", small_config.source, *files, "-o", page)
    assert (status, "must have a name of its own" in error) == (2, True)
    assert run(capsys, "report", small_config.source, files[0], "-o", page)[0] == 0
    assert str(tmp_path) not in page.read_text()  # pages name no directories


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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("report lbt.yaml k.fits -o x.pdf", "a page must end in .html; got 'x.pdf'"),
        ("report lbt.yaml k.fits -o x.html --title ", "--title must hold at least one letter"),
        ("report lbt.yaml FAST.fits -o x.html", "must run at the configuration's 800 Hz; got"),
        ("explore lbt.yaml --port 70000", "--port must be at most 65535"),
        (
            "explore lbt.yaml --origin a\x07b:8",
            "--origin must be HOST:PORT, as localhost:8080; got",
        ),
        ("explore lbt.yaml -o nowhere", "no directory nowhere"),
        ("explore lbt.yaml FAST.fits", "must run at the configuration's 800 Hz; got a design for"),
    ],
)
def test_wrong_words_are_refused(capsys, tmp_path, monkeypatch, small_designs, words, message):
    monkeypatch.chdir(tmp_path)
    shutil.copy(LBT_YAML, "lbt.yaml")
    lbt.save_gain("k.fits", small_designs["slow"])
    lbt.save_gain("FAST.fits", lbt.integrator(lbt.LoopHardware(frame_rate_hz=500), gain=0.3))
    status, out, error = run(capsys, *words.split(" "))
    assert (status, out, error.count("\n")) == (2, "", 1)
    assert message in error
    assert not (tmp_path / "x.html").exists()


VIEWS = ("bode", "nyquist", "nichols", "step", "sigma")


@pytest.mark.parametrize("view", VIEWS)
def test_a_view_writes_its_figure_and_its_points(view, tmp_path, capsys, gains):
    figure, table = tmp_path / f"{view}.png", tmp_path / f"{view}.csv"
    status, text, _ = run(
        capsys, "plot", view, gains["kalman"], gains["integrator"], "-o", figure, "-o", table
    )
    assert status == 0
    assert text.startswith("kalman survives 0.47 frames more delay")
    assert figure.read_bytes().startswith(b"\x89PNG")
    data = json.loads(run(capsys, "plot", view, gains["kalman"], gains["integrator"], "--json")[1])
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for curve in data["curves"]:
        named = [
            row for row in rows if (row["panel"], row["curve"]) == (curve["panel"], curve["name"])
        ]
        assert {float(row["y"]) for row in named if row["y"]} >= {y for y in curve["y"] if y}
    names = {curve["name"].partition(":")[0] for curve in data["curves"]}
    assert names >= ({"loop"} if view == "nyquist" else {"kalman", "integrator"})


def test_points_of_a_loop_are_those_of_an_integrator(capsys, gains):
    data = json.loads(run(capsys, "plot", "bode", gains["integrator"], "--json")[1])
    gain, phase = (c for c in data["curves"] if c["name"].startswith("integrator"))
    z = np.exp(2j * np.pi * np.array(gain["x"]) / 800)
    expected = 0.5 * z**-2 / (1 - 1 / z)
    assert gain["y"] == pytest.approx(20 * np.log10(np.abs(expected)), abs=1e-6)
    assert np.exp(1j * np.radians(phase["y"])) == pytest.approx(expected / abs(expected), abs=1e-6)
    assert (gain["panel"], gain["heading"]) == ("loop gain [dB]", "frequency [Hz]")


def test_overshoot_and_settling_time(capsys, gains):
    status, text, _ = run(capsys, "plot", "step", gains["integrator"])
    assert status == 0
    assert "settling time, to 5 % [ms]" in text
    (row,) = json.loads(run(capsys, "plot", "step", gains["integrator"], "--json")[1])["steps"]
    assert row["overshoot_percent"] == pytest.approx(25.0)  # 1, 1, 0.5, 0, -0.25, -0.25, ...


def test_without_a_stable_loop_there_is_nothing_to_draw(tmp_path, capsys, gains):
    out = tmp_path / "bode.csv"
    status, _, error = run(
        capsys, "plot", "bode", gains["integrator"], "--gain-factor", 3, "-o", out
    )
    assert (status, out.exists()) == (1, False)
    assert "no loop is stable at 3 times the sensor gain" in error
