"""The command telemetry, and the telemetry of simulate."""

import hashlib
import json
import sys

import numpy as np
import pytest
from support.commands import run
from support.plants import LBT_YAML
from support.telemetry import full, same

import lbt_synth as lbt
from lbt_synth.files.telemetry.aot import lost_fields


@pytest.fixture(scope="module")
def gain(tmp_path_factory):
    hardware = lbt.load_config(LBT_YAML).hardware
    folder = tmp_path_factory.mktemp("gain")
    return lbt.save_gain(folder / "slow.fits", lbt.integrator(hardware, gain=0.4))


@pytest.fixture
def night(tmp_path):
    return lbt.files.save_telemetry(tmp_path / "night.fits", full())


def test_simulate_writes_its_first_case(tmp_path, capsys, gain):
    out = tmp_path / "t.npz"
    options = ("--frames", 300, "--cases", 2, "--seed", 3, "--sensor-gain", 0.7)
    status, text, error = run(
        capsys, "simulate", LBT_YAML, gain, *options, "--telemetry", out, "--json"
    )
    assert (status, error) == (0, "")
    data = json.loads(text)
    assert data["telemetry"] == str(out)
    seen = lbt.files.load_telemetry(out)
    assert seen.commands.shape == (300, 2)
    rms = np.sqrt(np.sum(np.mean(seen.residual_nm**2, axis=0)))
    (row,) = data["designs"]
    assert 0.99 * rms < row["cases_residual_nm"][0] < 1.2 * rms  # and what moves within frames
    facts, digest = seen.metadata, hashlib.sha256(gain.read_bytes()).hexdigest()
    assert facts["strehl"] == pytest.approx(data["designs"][0]["cases_strehl"][0])
    assert (facts["seed"], facts["controller"], seen.sensor_gain) == (3, "integrator", 0.7)
    assert (facts["gain_file_sha256"], facts["case"], facts["cases"]) == (digest, 0, 2)
    # y(k) - g phi_res(k-1) is the noise: white, and of the size that the file gives
    noise = seen.measurements[1:] - 0.7 * seen.residual_nm[:-1]
    for axis in (0, 1):
        assert np.std(noise[:, axis]) == pytest.approx(
            seen.metadata[f"noise_nm_{axis + 1}"], rel=0.1
        )
    status, text, _ = run(
        capsys, "simulate", LBT_YAML, gain, "--frames", 50, "--telemetry", tmp_path / "u.fits"
    )
    assert status == 0
    assert "u.fits" in text


def test_what_is_in_a_file(capsys, night):
    status, text, error = run(capsys, "telemetry", night, "--verbose")
    assert (status, error) == (0, "")
    seen = full()
    words = "6 frames/2 modes/measurements/6 x 3/pixel/frame rate/2.25"
    for part in (*words.split("/"), "mirror, natural_frequency_hz", seen.convention):
        assert part in text
    status, text, _ = run(capsys, "telemetry", night, "--json")
    data = json.loads(text)
    assert status == 0
    assert data["arrays"]["measurements"] == [6, 3]
    assert data["units"]["measurements"] == "pixel"
    assert data["rms"]["commands"] == pytest.approx(np.sqrt(np.sum(seen.commands**2) / 6))
    assert "times_s" not in data["rms"]
    assert (data["frame_rate_hz"], data["delay_frames"]) == (800, 2.25)
    assert data["metadata"] == dict(seen.metadata)
    assert data["mirror"]["ramp_samples"] == 3
    assert data["mirror_taps"] == seen.mirror_taps.tolist()


def test_conversion_between_formats(tmp_path, capsys, night):
    out = tmp_path / "copy.npz"
    status, text, _ = run(capsys, "telemetry", night, "-o", out)
    assert status == 0
    assert f"written: {out}" in text
    assert same(lbt.files.load_telemetry(night), lbt.files.load_telemetry(out))


@pytest.mark.e2e
def test_conversion_to_the_standard_says_what_is_lost(tmp_path, capsys, night):
    out = tmp_path / "copy.aot.fits"
    status, text, _ = run(capsys, "telemetry", night, "-o", out)
    assert status == 0
    assert "the AOT standard has no place for residual_nm, total_nm" in text
    seen = lbt.files.load_telemetry(night)
    assert same(seen, lbt.files.load_telemetry(out), but=lost_fields(seen), rtol=1e-14)
    status, text, _ = run(capsys, "telemetry", out, "--json", "-o", tmp_path / "b.aot.fits")
    assert status == 0
    assert json.loads(text)["lost"] == []


READING = (
    *("--columns", "measurements=a,b", "commands=c,d", "times=", "--unit", "mas"),
    *("--command-unit", "nm", "--diameter-m", 8.22, "--obstruction", 0.2, "--delay-frames", 2),
    *("--frame-rate-hz", 1000, "--command-sign", -1, "--command-scale", 2, "--sensor-gain", 0.7),
)


def test_a_record_is_read_once(tmp_path, capsys, recorded_loop):
    """What was said of a file is in the telemetry of it: no command needs to be told again."""
    loop, _, _ = recorded_loop
    y, u = loop.measurements[0, :6000] / lbt.models.nm_per_mas(8.22), -loop.commands[0, :6000] / 2
    y[1000:1002], y[2000, 1] = np.nan, 1e4
    table, night = tmp_path / "night.csv", tmp_path / "night.fits"
    stamps = np.zeros((6000, 1))
    np.savetxt(table, np.hstack([stamps, y, u]), delimiter=",", comments="", header="time,a,b,c,d")
    status, text, error = run(capsys, "telemetry", table, *READING, "-o", night)
    assert (status, error) == (0, "")
    assert f"written: {night}" in text
    assert "6000 frames are usable" in text
    models, designs = [], []
    for name, options in (("a", (table, *READING)), ("b", (night,))):
        model = tmp_path / f"{name}.yaml"
        assert run(capsys, "identify", *options, "-o", model, "--no-figure")[0] == 0
        models.append(model.read_text().split("\n", 1)[1])
        gain = tmp_path / f"{name}.fits"
        status, text, _ = run(
            capsys, "auto", "--verbose", *options, "-o", gain, "--no-figure", "--method", "kalman"
        )
        assert status == 0
        assert "assumes: the commands of the record were read with --command-sign -1" in text
        designs.append(lbt.load_gain(gain))
    assert models[0].replace("night.csv", "") == models[1].replace("night.fits", "")
    assert np.array_equal(designs[0].controller.A, designs[1].controller.A)
    assert designs[0].assumptions == designs[1].assumptions
    status, text, _ = run(capsys, "diagnose", night)
    assert status == 0
    assert "The record is sound" in text
    status, text, _ = run(capsys, "telemetry", "--verbose", night)
    assert status == 0
    assert "--command-sign -1 --command-scale 2" in text


def test_an_open_loop_is_read_once_and_a_spectrum_is_not(tmp_path, capsys):
    y = 20 * np.random.default_rng(0).standard_normal((300, 2))
    np.save(tmp_path / "y.npy", y)
    options = ("--columns", "open_loop=0,1", "--unit", "nm", "--frame-rate-hz", 500)
    night = tmp_path / "y.npz"
    assert run(capsys, "telemetry", tmp_path / "y.npy", *options, "-o", night)[0] == 0
    record = lbt.load_record(night)
    assert (record.commands, record.frame_rate_hz) == (None, 500)
    assert np.array_equal(record.measurements, y)
    spectrum = tmp_path / "s.csv"
    spectrum.write_text("f_hz,psd_nm2_hz\n1,2\n2,3\n")
    status, _, error = run(capsys, "telemetry", spectrum)
    assert status == 2
    assert "telemetry holds recorded series; got a spectrum" in error


def test_bad_input_is_one_line(tmp_path, capsys, night, gain):
    for arguments, words in (
        (("telemetry", gain), "Choose by --columns measurements="),
        (("telemetry", night, "-o", tmp_path / "t.txt"), "must end in .fits, .npz or .aot.fits"),
        (("simulate", LBT_YAML, gain, "--telemetry", "t.txt"), "telemetry must end in"),
    ):
        status, text, error = run(capsys, *arguments)
        assert (status, text) == (2, "")
        assert error.startswith("lbt-synth: error: ")
        assert words in error
        assert error.count("\n") == 1


def test_without_aotpy_nothing_is_begun(tmp_path, capsys, monkeypatch, night, gain):
    monkeypatch.setitem(sys.modules, "aotpy", None)
    out = tmp_path / "t.aot.fits"
    for arguments in (
        ("telemetry", night, "-o", out),
        ("simulate", LBT_YAML, gain, "--telemetry", out),
    ):
        status, _, error = run(capsys, *arguments)
        assert status == 2
        assert 'pip install "lbt-synth[aot]"' in error
        assert error.count("\n") == 1
    assert not out.exists()
