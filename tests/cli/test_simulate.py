"""The command simulate, with one sensor and with several that may fail."""

import json
import re

import numpy as np
import pytest
from astropy.io import fits
from support.commands import refuse_commands, run, run_done, run_json
from support.drifting import drift_file
from support.plants import LBT_YAML
from support.several_sensors import CONFIG as SEVERAL_SENSORS
from support.several_sensors import write_config

import lbt_synth as lbt
from lbt_synth.cli.simulate import tiptop_spectrum
from lbt_synth.errors import ProblemError

CONFIG = str(LBT_YAML)


def test_simulate(tmp_path, capsys, gains):
    """A line for each gain file, as it would be alone: one seed is one weather."""
    out, few = tmp_path / "run.png", ("--frames", 1000, "--cases", 2)
    data = run_json(capsys, "simulate", CONFIG, *gains.values(), *few)
    assert [row["design"] for row in data["designs"]] == list(gains)
    words = ("simulate", CONFIG, gains["kalman"], *few)
    (row,) = run_json(capsys, *words, "-o", out)["designs"]
    assert row == data["designs"][0]
    assert out.exists()
    assert len(row["cases_strehl"]) == 2
    assert row["strehl_exact"] == pytest.approx(0.827, abs=0.002)
    dim = run_json(capsys, *words, "--sensor-gain", 0.4)
    assert dim["sensor_gain"] == 0.4
    assert dim["designs"][0]["strehl_exact"] < row["strehl_exact"]


def test_the_spectrum_is_what_tiptop_reads(tmp_path, capsys, gains):
    """By the formulas of its packages: MASTSEL 1.5.4, loadWindPsd; P3 1.6.4, windShakePSD."""
    out = tmp_path / "residual.fits"
    words = ("simulate", CONFIG, gains["kalman"], "--frames", 50, "--spectrum", out)
    data = run_json(capsys, *words)
    assert data["files"] == [str(out)]
    residual_nm = data["designs"][0]["residual_exact_nm"]
    with fits.open(out, checksum=True) as units:
        rows = units[0].data
        assert (units[0].header["BUNIT"], rows.shape) == ("nm^2/Hz", (3, 2001))
    for first_hz, points in ((0.2, 5 * 400), (0.1, 5 * 800)):
        frequency_hz = np.linspace(first_hz, 400, points)
        tip, tilt = (np.interp(frequency_hz, rows[0], row, left=0, right=0) for row in rows[1:])
        power = np.sum(tip + tilt) * (frequency_hz[1] - frequency_hz[0])
        assert np.sqrt(power) == pytest.approx(residual_nm, rel=1e-4)
    assert np.sqrt(np.trapezoid(rows[1:], rows[0]).sum()) == pytest.approx(residual_nm, rel=1e-4)


def test_spectra_that_are_refused(tmp_path, capsys, gains):
    out = tmp_path / "residual.fits"
    rows = (
        ("simulate CONFIG KALMAN --spectrum a.csv", "a spectrum must end in .fits; got 'a.csv'"),
        ("simulate CONFIG KALMAN HINF --spectrum OUT", "--spectrum goes with one gain file; got 2"),
    )
    places = {name.upper(): path for name, path in gains.items()}
    refuse_commands(capsys, rows, CONFIG=CONFIG, OUT=out, **places)
    path = lbt.LoopHardware(frame_rate_hz=800, modes=3)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3).controller)
    with pytest.raises(ProblemError, match="takes a loop of tip and tilt; got 3 modes"):
        tiptop_spectrum(loop, lbt.Truth(turbulence=None, noise_nm=1.0))
    assert not out.exists()


def test_a_mirror_of_little_stroke(capsys, gains):
    words = ("simulate", CONFIG, gains["kalman"], "--frames", 500, "--cases", 1)
    (free,) = run_json(capsys, *words)["designs"]
    left = {}
    for form in ("plain", "estimator"):
        (row,) = run_json(capsys, *words, "--stroke", 1200, "--form", form)["designs"]
        left[form] = row["residual_simulated_nm"], row["clipped"]
    assert left["plain"] > left["estimator"] > (free["residual_simulated_nm"], 0)
    assert left["plain"][1] > left["estimator"][1] > 0


def test_an_unstable_loop_has_status_1(capsys, gains):
    words = ("simulate", CONFIG, gains["hinf"], "--sensor-gain", 0.3, "--json")
    status, out, error = run(capsys, *words)
    assert (status, json.loads(out)["error"]) == (1, "UnstableLoopError")
    assert "the closed loop must be stable" in error


def test_the_commands_simulate_it_or_refuse(tmp_path, capsys):
    """A vibration that drifts."""
    config, gain = drift_file(tmp_path), tmp_path / "kalman.fits"
    text = run_done(capsys, "design", config, "--method", "kalman", "-o", gain)
    assert "a vibration of the truth drifts" in " ".join(text.split())
    (row,) = run_json(capsys, "simulate", config, gain)["designs"]
    assert row["strehl_exact"] is None
    assert 0 < row["cases_strehl"][0] < 1
    for words in ("limits CONFIG GAIN", "robustness CONFIG GAIN"):
        rows = [(words, "drifts from 17 to 23 Hz")]
        refuse_commands(capsys, rows, CONFIG=config, GAIN=gain)


@pytest.fixture
def config_file(tmp_path):
    return write_config(tmp_path, SEVERAL_SENSORS)


def test_sensors_that_fail_on_the_way(tmp_path, capsys, config_file, sensors_file):
    """The run reaches beyond the last event."""
    figure = tmp_path / "drops.png"
    drops = ("--drop", "m2@0.2s", "--drop", "wavefront@0.5s..0.7s:frozen")
    data = run_json(capsys, "simulate", config_file, sensors_file, *drops, "--cases", 1)
    assert data["frames"] == 5700
    sensors = ["none", "m2", "m2, wavefront (frozen)", "m2"]
    assert [row["sensors"] for row in data["segments"]] == sensors
    short = ("--frames", 1000, "--cases", 1, "-o", figure)
    text = run_done(capsys, "simulate", config_file, sensors_file, *drops, *short)
    assert "Simulated between failures and returns" in text
    assert figure.stat().st_size > 10_000


def test_what_it_refuses(capsys, config_file, sensors_file, gains):
    rows = [
        ("simulate SEVERAL SENSORS --drop m2", "--drop takes SENSOR@START..END"),
        ("simulate SEVERAL SENSORS --drop m2@5s --frames 1000", "--frames must reach beyond"),
        ("simulate SEVERAL SENSORS --stroke 100", "goes with a design of the loop's own sensor"),
        ("simulate SEVERAL KALMAN --drop m2@1s", "--drop goes with a design of several sensors"),
        ("simulate CONFIG KALMAN HINF -o a.png", "goes with one gain file; got 2."),
        ("simulate CONFIG KALMAN HINF --telemetry a.fits", "goes with one gain file; got 2."),
        ("plot sigma SENSORS", "is a design of several sensors"),
        ("rehearse none.npz SENSORS --for c", "is a design of several sensors"),
    ]
    files = {"SEVERAL": config_file, "SENSORS": sensors_file, "CONFIG": CONFIG}
    refuse_commands(capsys, rows, **files, KALMAN=gains["kalman"], HINF=gains["hinf"])


def test_what_shows_a_design_of_several_sensors(capsys, config_file, sensors_file):
    text = run_done(capsys, "show", sensors_file, "--verbose")
    assert "When sensors fail" in text
    assert "wavefront + slow + m1 + m2" in text
    assert "of the loop's own sensor in the truth" in text
    assert "verified" in run_done(capsys, "verify", sensors_file)
    text = run_done(capsys, "limits", config_file, sensors_file)
    assert re.search(r"^ +sensors +37\.40 ", text, re.MULTILINE)
    assert "runs with the sensors of the gain file" not in text


def test_other_sensors_than_those_of_the_configuration_are_named(tmp_path, capsys, sensors_file):
    noisy = SEVERAL_SENSORS.replace("noise_m_s2: 2.0e-4", "noise_m_s2: 2.0e-2")
    words = ("simulate", write_config(tmp_path, noisy), sensors_file, "--frames", 500)
    assert "runs with the sensors of the gain file beside the loop's own" in run_done(
        capsys, *words
    )


def test_commands_that_read_the_own_sensor_alone_say_so(capsys, config_file):
    text = run_done(capsys, "tradeoff", config_file, "--points", 2, "--taps", 2)
    assert "note: the loop's own sensor is read alone, without slow, m1, m2." in text
