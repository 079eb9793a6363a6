"""The command simulate, with one sensor and with several that may fail."""

import json
import re

import pytest
from support.commands import run
from support.drifting import drift_file
from support.plants import LBT_YAML
from support.several_sensors import CONFIG as SEVERAL_SENSORS
from support.several_sensors import write_config

from lbt_synth.cli.main import main
from lbt_synth.cli.simulate import parse_drop

CONFIG = str(LBT_YAML)


def test_simulate(tmp_path, capsys, gains):
    out = tmp_path / "run.png"
    arguments = ("simulate", CONFIG, gains["kalman"], "--frames", 2000, "--cases", 2)
    status, text, _ = run(capsys, *arguments, "-o", out)
    assert status == 0
    assert "Strehl ratio" in text
    assert out.exists()
    data = json.loads(run(capsys, *arguments, "--json")[1])
    (row,) = data["designs"]
    assert len(row["cases_strehl"]) == 2
    assert row["strehl_exact"] == pytest.approx(0.827, abs=0.002)
    again = json.loads(run(capsys, *arguments, "--json")[1])
    assert again == data  # seeds make runs repeatable
    dim = json.loads(run(capsys, *arguments, "--json", "--sensor-gain", 0.4)[1])
    assert dim["sensor_gain"] == 0.4
    assert dim["designs"][0]["strehl_exact"] < row["strehl_exact"]


def test_a_mirror_of_little_stroke(capsys, gains):
    arguments = ("simulate", CONFIG, gains["kalman"], "--frames", 500, "--cases", 1)
    (free,) = json.loads(run(capsys, *arguments, "--json")[1])["designs"]
    left = {}
    for form in ("plain", "estimator"):
        limited = (*arguments, "--stroke", 1200, "--form", form)
        (row,) = json.loads(run(capsys, *limited, "--json")[1])["designs"]
        left[form] = row["residual_simulated_nm"], row["clipped"]
    assert left["plain"] > left["estimator"] > (free["residual_simulated_nm"], 0)
    assert left["plain"][1] > left["estimator"][1] > 0
    assert "note: the mirror clipped the commands of" in run(capsys, *limited)[1]


def test_an_unstable_loop_has_status_1(capsys, gains):
    status, out, error = run(
        capsys, "simulate", CONFIG, gains["hinf"], "--sensor-gain", 0.3, "--json"
    )
    assert status == 1
    assert json.loads(out)["error"] == "UnstableLoopError"
    assert "the closed loop must be stable" in error


def test_the_commands_simulate_it_or_refuse(tmp_path, capsys):
    config, gain = str(drift_file(tmp_path)), str(tmp_path / "kalman.fits")
    assert main(["design", config, "--method", "kalman", "-o", gain]) == 0
    capsys.readouterr()
    assert main(["simulate", config, gain]) == 0
    out = capsys.readouterr().out
    assert "a vibration drifts" in out
    assert main(["simulate", config, gain, "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["designs"]
    assert row["strehl_exact"] is None
    assert 0 < row["cases_strehl"][0] < 1
    for refused in (
        ["limits", config, gain],
        ["robustness", config, gain, "-o", str(tmp_path / "r.csv")],
        ["design", config, "--method", "integrator", "-o", str(tmp_path / "i.fits")],
    ):
        assert main(refused) == 2
        assert "drifts from 17 to 23 Hz" in " ".join(capsys.readouterr().err.split())


_OTHER_SENSORS = "runs with the sensors of the gain file beside the loop's own"


@pytest.fixture
def config_file(tmp_path):
    return write_config(tmp_path)


def test_sensors_that_fail_on_the_way(tmp_path, capsys, config_file, sensors_file):
    figure = tmp_path / "drops.png"
    status, text, _ = run(
        capsys,
        *("simulate", config_file, sensors_file, "--drop", "m2@0.5s", "-o", figure),
        *("--drop", "wavefront@1s..1.2s", "--frames", 2000),
    )
    assert status == 0
    assert "m2, wavefront" in text
    assert figure.stat().st_size > 10_000


def test_the_run_reaches_beyond_the_last_event(capsys, config_file, sensors_file):
    arguments = ("simulate", config_file, sensors_file, "--drop", "m2@0.5s", "--cases", 1, "--json")
    data = json.loads(run(capsys, *arguments)[1])
    assert data["frames"] == 5500
    assert [row["sensors"] for row in data["segments"]] == ["none", "m2"]
    assert "Simulated between failures and returns" in run(capsys, *arguments[:-1])[1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--drop", "m2"), "--drop takes SENSOR@START..END"),
        (("--drop", "m2@5s", "--frames", 1000), "--frames must reach beyond"),
        (("--stroke", 100), "--stroke goes with a design of the loop's own sensor alone."),
    ],
)
def test_what_it_refuses(capsys, config_file, sensors_file, arguments, said):
    status, out, error = run(capsys, "simulate", config_file, sensors_file, *arguments)
    assert status != 0
    assert out == ""
    assert said in error


def test_a_design_of_one_sensor_has_nothing_to_drop(capsys, config_file, gains):
    status, _, error = run(capsys, "simulate", config_file, gains["kalman"], "--drop", "m2@1s")
    assert status == 2
    assert "--drop goes with a design of several sensors" in error


@pytest.mark.parametrize("command", [("plot sigma",), ("rehearse none.npz", "--for", "c")])
def test_commands_for_one_sensor_say_so(capsys, sensors_file, command):
    status, out, error = run(capsys, *command[0].split(), sensors_file, *command[1:])
    assert (status, out) == (2, "")
    assert "is a design of several sensors" in error


def test_show_prints_what_failures_do(capsys, sensors_file):
    status, text, _ = run(capsys, "show", sensors_file, "--verbose")
    assert status == 0
    assert "When sensors fail" in text
    assert "wavefront + slow + m1 + m2" in text
    assert "of the loop's own sensor in the truth" in text


def test_verify_and_limits_take_it(tmp_path, capsys, sensors_file):
    assert "verified" in run(capsys, "verify", sensors_file)[1]
    few = write_config(tmp_path, SEVERAL_SENSORS + "robustness: {errors_hz: [0]}\n")
    status, text, _ = run(capsys, "limits", few, sensors_file)
    assert status == 0
    assert re.search(r"^ +sensors +37\.40 ", text, re.MULTILINE)
    assert _OTHER_SENSORS not in text


@pytest.mark.parametrize("command", ["limits", "simulate"])
def test_other_sensors_than_those_of_the_configuration_are_named(
    tmp_path, capsys, sensors_file, command
):
    noisy = SEVERAL_SENSORS.replace("noise_m_s2: 2.0e-4", "noise_m_s2: 2.0e-2")
    few = write_config(tmp_path, noisy + "robustness: {errors_hz: [0]}\n")
    status, text, _ = run(capsys, command, few, sensors_file)
    assert status == 0
    assert _OTHER_SENSORS in text


def test_commands_that_read_the_own_sensor_alone_say_so(capsys, config_file):
    status, text, _ = run(capsys, "tradeoff", config_file, "--points", 2)
    assert status == 0
    assert "note: the loop's own sensor is read alone, without slow, m1, m2." in text


def test_what_a_drop_says():
    drop = parse_drop("wavefront@20s..20.2s:frozen")
    assert (drop.unit, drop.start_s, drop.end_s) == ("wavefront", 20, 20.2)
    assert drop.reading == "frozen"


def test_several_gain_files_are_a_line_each(tmp_path, capsys, gains):
    """Each line is what the command prints of the file alone: one seed is one weather."""
    few = ("--frames", 500, "--cases", 2)
    data = json.loads(run(capsys, "simulate", CONFIG, *gains.values(), *few, "--json")[1])
    assert [row["design"] for row in data["designs"]] == list(gains)
    for row, gain in zip(data["designs"], gains.values(), strict=True):
        (alone,) = json.loads(run(capsys, "simulate", CONFIG, gain, *few, "--json")[1])["designs"]
        assert row == alone
    for option, name in (("-o", "a.png"), ("--telemetry", "a.fits")):
        words = (*gains.values(), option, tmp_path / name)
        status, _, error = run(capsys, "simulate", CONFIG, *words)
        assert (status, "goes with one gain file; got 3." in error) == (2, True)
