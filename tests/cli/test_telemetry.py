"""The command telemetry, and the telemetry of simulate."""

import hashlib
import re
import sys

import numpy as np
import pytest
from support.commands import refuse_commands, run_done, run_json
from support.night import simulated_night
from support.plants import LBT_YAML
from support.telemetry import full, same

import lbt_synth as lbt
from lbt_synth.files.telemetry.aot import lost_fields


@pytest.fixture
def night(tmp_path):
    return lbt.files.save_telemetry(tmp_path / "night.fits", full())


def test_simulate_writes_its_first_case(tmp_path, capsys, gains):
    out, gain = tmp_path / "t.npz", gains["integrator"]
    options = ("--frames", 300, "--cases", 2, "--seed", 3, "--sensor-gain", 0.7)
    data = run_json(capsys, "simulate", LBT_YAML, gain, *options, "--telemetry", out)
    assert data["files"] == [str(out)]
    seen = lbt.files.load_telemetry(out)
    assert seen.commands.shape == (300, 2)
    rms = np.sqrt(np.sum(np.mean(seen.residual_nm**2, axis=0)))
    (row,) = data["designs"]
    assert 0.99 * rms < row["cases_residual_nm"][0] < 1.2 * rms  # and what moves within frames
    facts, digest = seen.metadata, hashlib.sha256(gain.read_bytes()).hexdigest()
    assert facts["strehl"] == pytest.approx(row["cases_strehl"][0])
    assert (facts["seed"], facts["controller"], seen.sensor_gain) == (3, "integrator", 0.7)
    assert (facts["gain_file_sha256"], facts["case"], facts["cases"]) == (digest, 0, 2)
    # y(k) - g phi_res(k-1) is the noise: white, and of the size that the file gives
    noise = np.std(seen.measurements[1:] - 0.7 * seen.residual_nm[:-1], axis=0)
    assert noise == pytest.approx([facts["noise_nm_1"], facts["noise_nm_2"]], rel=0.1)


def test_what_is_in_a_file(capsys, night):
    seen, text = full(), run_done(capsys, "telemetry", night, "--verbose")
    words = "6 frames/2 modes/measurements/6 x 3/pixel/frame rate/2.25"
    for word in (*words.split("/"), "mirror, natural_frequency_hz", seen.convention):
        assert word in text
    data = run_json(capsys, "telemetry", night)
    stated = {"frame_rate_hz": 800, "delay_frames": 2.25, "metadata": dict(seen.metadata)}
    stated["mirror_taps"] = seen.mirror_taps.tolist()
    assert {name: data[name] for name in stated} == stated
    assert (data["arrays"]["measurements"], data["units"]["measurements"]) == ([6, 3], "pixel")
    assert data["mirror"]["ramp_samples"] == 3
    assert data["rms"]["commands"] == pytest.approx(np.sqrt(np.sum(seen.commands**2) / 6))
    assert "times_s" not in data["rms"]


def test_conversion_between_formats_keeps_the_control_loop_that_was_taken(tmp_path, capsys):
    loops = {"aot_loop": "HO loop", "aot_loops": "HO loop, TT loop"}
    night = lbt.files.save_telemetry(tmp_path / "night.fits", full(metadata=loops))
    text = run_done(capsys, "telemetry", night, "-o", tmp_path / "copy.npz")
    words = "HO loop is one of the control loops HO loop, TT loop; see --loop"
    assert all(said in text for said in (words, f"written: {tmp_path / 'copy.npz'}"))
    assert same(full(metadata=loops), lbt.files.load_telemetry(tmp_path / "copy.npz"))


@pytest.mark.e2e
def test_conversion_to_the_standard_says_what_is_lost(tmp_path, capsys, night):
    out, seen = tmp_path / "copy.aot.fits", full()
    text = run_done(capsys, "telemetry", night, "-o", out)
    assert "the AOT standard has no place for residual_nm, total_nm" in text
    assert same(seen, lbt.files.load_telemetry(out), but=lost_fields(seen), rtol=1e-14)
    assert run_json(capsys, "telemetry", out, "-o", tmp_path / "b.aot.fits")["lost"] == []


READING = (
    *("--columns", "measurements=a,b", "commands=c,d", "times=", "--unit", "mas"),
    *("--command-unit", "nm", "--diameter-m", 8.22, "--obstruction", 0.2, "--delay-frames", 2),
    *("--frame-rate-hz", 1000, "--command-sign", -1, "--command-scale", 2, "--sensor-gain", 0.7),
)


def test_a_record_is_read_once(tmp_path, capsys):
    """What was said of a file is in the telemetry of it: no command needs to be told again."""
    loop = simulated_night()[0]
    y, u = loop.measurements[0, :6000] / lbt.models.nm_per_mas(8.22), -loop.commands[0, :6000] / 2
    y[1000:1002], y[2000, 1] = np.nan, 1e4
    table, night = tmp_path / "night.csv", tmp_path / "night.fits"
    columns = np.hstack([np.zeros((6000, 1)), y, u])
    np.savetxt(table, columns, delimiter=",", comments="", header="time,a,b,c,d")
    text = run_done(capsys, "telemetry", table, *READING, "-o", night)
    assert f"written: {night}" in text
    assert "6000 frames are usable" in text
    models = []
    for name, options in (("a", (table, *READING)), ("b", (night,))):
        model = tmp_path / f"{name}.yaml"
        run_done(capsys, "identify", *options, "-o", model, "--no-figure")
        models.append(model.read_text().split("\n", 1)[1])
    assert models[0].replace("night.csv", "") == models[1].replace("night.fits", "")
    gain, other = tmp_path / "tt.fits", tmp_path / "k.fits"
    words = ("auto", night, "-o", gain, "--no-figure", "--method", "kalman")
    options = "--command-sign -1 --command-scale 2"
    read = f"the commands of the record were read with {options}"
    assert read in run_json(capsys, *words)["assumptions"][0]
    assert "The record is sound" in run_done(capsys, "diagnose", night)
    text = run_done(capsys, "telemetry", "--verbose", night)
    assert options in text
    assert re.search(r"commands +6000 x 2 +frame, command +mas ", text)
    assert "\nunits: mas\n" in model.read_text()
    run_done(capsys, "design", model, "--method", "kalman", "-o", other)
    shown = [("show", gain), ("show", other), ("plot", "step", gain), ("diagnose", night, gain)]
    for words in (*shown, ("rehearse", night, gain, "--for", "c")):
        assert not re.search(r"\bnm\b", run_done(capsys, *words, "--verbose")), words
    assert re.search(r"\[nm\]", run_done(capsys, "diagnose", night, "--show-unit", "nm"))


def test_an_open_loop_is_read_once(tmp_path, capsys):
    y = 20 * np.random.default_rng(0).standard_normal((300, 2))
    np.save(tmp_path / "y.npy", y)
    options = ("--columns", "open_loop=0,1", "--unit", "nm", "--frame-rate-hz", 500)
    run_done(capsys, "telemetry", tmp_path / "y.npy", *options, "-o", tmp_path / "y.npz")
    record = lbt.load_record(tmp_path / "y.npz")
    assert (record.commands, record.frame_rate_hz) == (None, 500)
    assert np.array_equal(record.measurements, y)


def test_without_aotpy_nothing_is_begun(tmp_path, capsys, monkeypatch, night, gains):
    monkeypatch.setitem(sys.modules, "aotpy", None)
    out, advice = tmp_path / "t.aot.fits", 'pip install "lbt-synth[aot]"'
    commands = (f"telemetry {night} -o {out}", f"simulate {LBT_YAML} GAIN --telemetry {out}")
    rows = [(words, advice) for words in commands]
    refuse_commands(capsys, rows, GAIN=gains["integrator"])
    assert not out.exists()
