"""The commands plot, report and explore: their files, their output, and their errors."""

import csv
import hashlib
import json
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest
from support.commands import hear_interruptions, refuse_commands, run_json
from support.configs import with_errors
from support.plants import LBT_YAML

import lbt_synth as lbt


def test_a_page_is_made_of_gain_files(tmp_path, capsys, monkeypatch, gains):
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(with_errors(LBT_YAML.read_text(), 0))
    data = run_json(capsys, "report", "small.yaml", *gains.values(), "-o", "r.html")
    assert (data["files"], list(data["designs"])) == (["r.html"], list(gains))
    kalman, config = data["designs"]["kalman"], lbt.load_config("small.yaml")
    loop = lbt.close_loop(config.hardware, lbt.load_gain(gains["kalman"]).controller)
    assert kalman["residual_nm"] == pytest.approx(lbt.residual_budget(loop, config.truth).rms_nm)
    assert kalman["certified"] is True
    digest = hashlib.sha256(gains["kalman"].read_bytes()).hexdigest()
    assert data["sha256"]["kalman.fits"] == digest
    assert str(gains["kalman"].parent) not in Path("r.html").read_text()  # it names no directories


def test_a_place_that_is_not_free_is_said(capsys):
    cannot = "cannot serve at --host"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        hosts = {"localhost": f"--port {port}: Address already in use", "a" * 64: cannot}
        for host, words in (hosts | {"no.such.host.invalid": cannot}).items():
            command = f"explore {LBT_YAML} --host {host} --port {port}"
            refuse_commands(capsys, [(command, words)])


def test_it_serves_until_it_is_interrupted(tmp_path):
    words = f"-m lbt_synth explore {LBT_YAML} --port 0 -o {tmp_path} --json".split()
    command, options = [sys.executable, *words], {"preexec_fn": hear_interruptions, "text": True}
    options |= dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(command, **options) as process:
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
        points = [float(r["y"]) for r in rows if r["y"] and (r["panel"], r["curve"]) == place]
        assert {*points} >= {*filter(None, curve["y"])}
    names = {curve["name"].partition(":")[0] for curve in data["curves"]}
    assert names >= ({"loop"} if view == "nyquist" else {"kalman", "integrator"})
    if view == "step":  # of the integrator: 1, 1, 0.5, 0, -0.25, -0.25, ...
        assert data["steps"][1]["overshoot_percent"] == pytest.approx(25.0)
