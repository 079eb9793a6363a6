"""The command simulate."""

from __future__ import annotations

import json

import pytest
from support.commands import run
from support.drifting import drift_file
from support.plants import LBT_YAML

from lbt_synth.cli.main import main

CONFIG = str(LBT_YAML)


def test_simulate(tmp_path, capsys, gains):
    out = tmp_path / "run.png"
    arguments = ("simulate", CONFIG, gains["kalman"], "--frames", 2000, "--cases", 2)
    status, text, _ = run(capsys, *arguments, "-o", out)
    assert status == 0
    assert "Strehl ratio" in text
    assert out.exists()
    data = json.loads(run(capsys, *arguments, "--json")[1])
    assert len(data["strehl"]) == 2
    assert data["strehl_exact"] == pytest.approx(0.836, abs=0.002)
    again = json.loads(run(capsys, *arguments, "--json")[1])
    assert again == data  # seeds make runs repeatable
    dim = json.loads(run(capsys, *arguments, "--json", "--sensor-gain", 0.4)[1])
    assert dim["sensor_gain"] == 0.4
    assert dim["strehl_exact"] < data["strehl_exact"]


def test_a_mirror_of_little_stroke(capsys, gains):
    arguments = ("simulate", CONFIG, gains["kalman"], "--frames", 500, "--cases", 1)
    free = json.loads(run(capsys, *arguments, "--json")[1])
    left = {}
    for form in ("plain", "estimator"):
        limited = (*arguments, "--stroke", 1200, "--form", form)
        data = json.loads(run(capsys, *limited, "--json")[1])
        left[form] = data["residual_nm"][0], data["clipped"]
    assert left["plain"] > left["estimator"] > (free["residual_nm"][0], 0)
    assert left["plain"][1] > left["estimator"][1] > 0
    assert "note: the mirror clipped the commands of" in run(capsys, *limited)[1]


def test_an_unstable_loop_has_status_1(capsys, gains):
    status, out, error = run(
        capsys, "simulate", CONFIG, gains["hinf"], "--sensor-gain", 0.3, "--json"
    )
    assert status == 1
    assert json.loads(out)["error"] == "UnstableLoopError"
    assert "the closed loop must be stable" in error


def test_a_controller_for_another_loop_gets_a_note(tmp_path, capsys, gains):
    text = LBT_YAML.read_text().replace("delay_frames: 2.0", "delay_frames: 2.4")
    (tmp_path / "other.yaml").write_text(text)
    status, out, _ = run(
        capsys, "simulate", tmp_path / "other.yaml", gains["kalman"], "--frames", 500, "--cases", 1
    )
    assert status == 0
    assert "note: designed for a delay of 2 frames, run with 2.4." in out
    assert "scatter" not in out  # one run has none
    assert "1 run of 500 frames" in out


def test_the_commands_simulate_it_or_refuse(tmp_path, capsys):
    config, gain = str(drift_file(tmp_path)), str(tmp_path / "kalman.fits")
    assert main(["design", config, "--method", "kalman", "-o", gain]) == 0
    capsys.readouterr()
    assert main(["simulate", config, gain]) == 0
    out = capsys.readouterr().out
    assert "a vibration drifts" in out
    assert "least residual" not in out
    assert main(["simulate", config, gain, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["strehl_exact"] is None
    assert 0 < report["strehl"][0] < 1
    for refused in (
        ["limits", config, gain],
        ["robustness", config, "-o", str(tmp_path / "r.csv")],
        ["design", config, "--method", "integrator", "-o", str(tmp_path / "i.fits")],
    ):
        assert main(refused) == 2
        assert "drifts from 17 to 23 Hz" in " ".join(capsys.readouterr().err.split())
