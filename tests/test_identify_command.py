"""identify and auto at the command line: good records, and bad ones."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.recorded_loops import RATE, slow
from test_cli import run

import lbt_synth as lbt

LINE_HZ, LINE_NM, NOISE, GAIN = 31.0, 60.0, 8.0, 0.7


@pytest.fixture(scope="module")
def loop():
    """A loop of two axes that ran with an integrator: measurements, commands."""
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    line = lbt.Vibration(frequency_hz=LINE_HZ, damping=0.005, rms_nm=LINE_NM, direction=(1.0, 0.0))
    truth = lbt.Truth(turbulence=slow(), vibrations=(line,), noise_nm=NOISE, sensor_gain=GAIN)
    ran = lbt.integrator(path, gain=0.4)
    return lbt.simulate(ran.controller, truth, hardware=path, frames=12_000, seed=1), path, ran


@pytest.fixture(scope="module")
def night(loop, tmp_path_factory):
    run_, path, ran = loop
    seen = lbt.files.telemetry_from_simulation(run_, path, sensor_gain=GAIN, design=ran)
    return lbt.files.save_telemetry(tmp_path_factory.mktemp("night") / "night.fits", seen)


def test_identify_writes_a_configuration_that_designs(tmp_path, capsys, night):
    out = tmp_path / "model.yaml"
    status, text, error = run(capsys, "identify", night, "-o", out, "--wavelength-um", 1.65)
    assert (status, error) == (0, "")
    assert "Vibrations" in text
    assert "sensor gain" in text
    assert out.with_suffix(".png").stat().st_size > 10_000
    config = lbt.load_config(out)
    (line,) = config.plant.vibrations
    assert line.frequency_hz == pytest.approx(LINE_HZ, abs=0.2)
    assert line.direction == (1.0, 0.0)
    assert config.imaging.wavelength_um == 1.65
    assert config.settings.model.sensor_gain == pytest.approx([GAIN, GAIN], rel=0.15)
    gain = tmp_path / "k.fits"
    assert run(capsys, "design", out, "--method", "kalman", "-o", gain)[0] == 0
    assert run(capsys, "verify", gain)[0] == 0


@pytest.fixture(scope="module")
def made(night, tmp_path_factory):
    """Everything that auto writes, and what it says."""
    import contextlib
    import io

    from lbt_synth.cli.main import main

    out = tmp_path_factory.mktemp("auto") / "tt.fits"
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        assert main(["auto", str(night), "-o", str(out), "--json"]) == 0
    return out, json.loads(text.getvalue())


def test_auto_tests_its_design_on_unseen_data(made, loop):
    out, data = made
    rows = {row["name"]: row for row in data["held_out"]}
    assert list(rows) == [
        "what ran",
        "best integrator",
        "Kalman filter",
        "least-squares predictor",
        "limit of performance",
    ]
    kalman = rows["Kalman filter"]
    assert kalman["data_nm"] < 0.5 * rows["what ran"]["data_nm"]
    assert kalman["data_nm"] < 1.02 * rows["least-squares predictor"]["data_nm"]
    assert kalman["data_nm"] == pytest.approx(kalman["model_nm"], rel=0.1)
    # what ran is what the simulation left in its second half
    run_, _, _ = loop
    half = run_.residual_nm[0, len(run_.residual_nm[0]) // 2 :]
    true = np.sqrt(np.sum(np.mean(half**2, axis=0)))
    gain = data["axes"][0]["sensor_gain"]
    assert rows["what ran"]["data_nm"] == pytest.approx(true * GAIN / gain, rel=0.05)
    assert data["gain_over_what_ran"]["residual_nm"][1] == kalman["data_nm"]
    assert data["certificate"] is True
    assert lbt.load_gain(out).certificate.passed
    assert lbt.load_config(data["model"]).plant.vibrations
    assert out.with_suffix(".png").is_file()


def test_auto_says_what_it_found(capsys, night, tmp_path):
    out = tmp_path / "h.npz"
    status, text, error = run(
        capsys,
        "auto",
        night,
        "-o",
        out,
        "--method",
        "hinf",
        "--gamma-ratio",
        1.3,
        "--no-figure",
        "--model",
        tmp_path / "m.yml",
        "--sensor-gain",
        GAIN,
    )
    assert (status, error) == (0, "")
    assert "gain over what ran, on unseen data: residual" in text
    assert "sensor gain given." in text
    assert "H-infinity filter" in text
    assert not (tmp_path / "h.png").exists()
    assert (tmp_path / "m.yml").is_file()


@pytest.mark.parametrize("ending", ["npy", "npz", "csv", "fits"])
def test_series_of_any_format(tmp_path, capsys, loop, ending):
    run_, _, _ = loop
    y, u = run_.measurements[0], run_.commands[0]
    file = tmp_path / f"night.{ending}"
    options: tuple[object, ...] = ("--frame-rate-hz", 1000, "--delay-frames", 2, "--unit", "nm")
    if ending == "npy":
        np.save(file, np.hstack([y, u]))
        options += ("--columns", "measurements=0,1", "commands=2,3")
    elif ending == "npz":
        np.savez(file, measurements=y, commands=u)
    elif ending == "csv":
        np.savetxt(
            file,
            np.hstack([y, u]),
            delimiter=",",
            comments="",
            header="tip_nm,tilt_nm,command_tip_nm,command_tilt_nm",
        )
    else:
        from astropy.io import fits

        parts = [fits.PrimaryHDU(), fits.ImageHDU(y, name="MEASUREMENTS")]
        fits.HDUList([*parts, fits.ImageHDU(u, name="COMMANDS")]).writeto(file)
    status, text, error = run(
        capsys, "identify", file, "-o", tmp_path / "m.yaml", "--no-figure", "--json", *options
    )
    assert (status, error) == (0, "")
    tip = json.loads(text)["axes"][0]
    assert tip["vibrations"][0]["frequency_hz"] == pytest.approx(LINE_HZ, abs=0.2)


def test_an_open_loop_series_and_one_axis(tmp_path, capsys, loop):
    run_, _, _ = loop
    file = tmp_path / "open.npy"
    noise = np.random.default_rng(0).standard_normal(len(run_.total_nm[0]))
    np.save(file, run_.total_nm[0][:, 0] + NOISE * noise)
    status, text, error = run(
        capsys,
        "auto",
        file,
        "-o",
        tmp_path / "t.fits",
        "--kind",
        "open-loop",
        "--frame-rate-hz",
        1000,
        "--delay-frames",
        2,
        "--unit",
        "nm",
        "--no-figure",
    )
    assert (status, error) == (0, "")
    assert "what ran" not in text
    assert "Kalman filter" in text
    assert lbt.load_config(tmp_path / "t.yaml").plant.hardware.modes == 1


def test_a_spectrum(tmp_path, capsys):
    f = np.arange(1, 1600) * 0.25
    line = lbt.Vibration(frequency_hz=52, damping=0.02, rms_nm=30).ar_model(RATE)
    chance = np.random.default_rng(0).gamma(20.0, 1 / 20.0, f.size)
    file = tmp_path / "psd.csv"
    np.savetxt(
        file,
        np.column_stack([f, (line.psd(f) + 0.5) * chance]),
        delimiter=",",
        comments="",
        header="frequency_hz,psd_nm2/Hz",
    )
    options = ("--frame-rate-hz", 1000, "--delay-frames", 2, "--unit", "nm^2/Hz")
    status, _, error = run(
        capsys, "identify", file, "-o", tmp_path / "m.yaml", *options, "--kind", "spectrum"
    )
    assert (status, error) == (0, "")
    config = lbt.load_config(tmp_path / "m.yaml")
    assert config.hardware.frame_rate_hz == 1000
    assert config.plant.vibrations[0].frequency_hz == pytest.approx(52, abs=0.3)
    status, _, error = run(
        capsys, "auto", file, "-o", tmp_path / "t.fits", *options, "--kind", "spectrum"
    )
    assert status == 2
    assert "got a spectrum" in error


def test_accelerometers_and_lists_announce_lines(tmp_path, capsys, loop, night):
    run_, _, _ = loop
    rng = np.random.default_rng(2)
    shake = np.diff(run_.total_nm[0][:, 0], n=2, prepend=[0, 0])
    sensors = np.column_stack([shake, rng.standard_normal(len(shake))])
    sensors[:, 0] += 0.1 * np.std(shake) * rng.standard_normal(len(shake))
    np.save(tmp_path / "a.npy", sensors)
    (tmp_path / "lines.txt").write_text("31.0 0.1\n")
    for options in (
        ("--accelerometers", tmp_path / "a.npy"),
        ("--lines-file", tmp_path / "lines.txt"),
        ("--lines-hz", 31, 77),
    ):
        status, text, error = run(
            capsys, "identify", night, "-o", tmp_path / "m.yaml", "--no-figure", "--json", *options
        )
        assert (status, error) == (0, "")
        (line,) = json.loads(text)["axes"][0]["vibrations"]
        assert line["announced"]
        assert line["frequency_hz"] == pytest.approx(LINE_HZ, abs=0.2)


def test_faults_are_in_the_report(tmp_path, capsys, loop):
    run_, _, _ = loop
    y, u = run_.measurements[0].copy(), run_.commands[0]
    y[5000:5400] = np.nan
    y[8000] = np.nan
    np.savez(tmp_path / "n.npz", measurements=y, commands=u)
    options = ("--frame-rate-hz", 1000, "--delay-frames", 2, "--unit", "nm", "--no-figure")
    status, text, _ = run(
        capsys, "identify", tmp_path / "n.npz", "-o", tmp_path / "m.yaml", *options
    )
    assert status == 0
    assert "not finite" in text
    assert "interpolated" in text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("-o", "m.txt"), "must end in .yaml"),
        (("-o", "m.yaml", "--figure", "m.gif"), "must end in .png"),
        (("-o", "m.yaml", "--figure", "x.png", "--no-figure"), "not both"),
        (("-o", "nowhere/m.yaml"), "no directory"),
        (("-o", "m.yaml", "--frame-rate-hz", "900"), "must be that of the telemetry"),
        (("-o", "m.yaml", "--columns", "a"), "takes ROLE=NAME"),
        (("-o", "m.yaml", "--sensor-gain", "1", "2", "3"), "one number, or 2"),
        (("-o", "m.yaml", "--sensor-gain", "0"), "sensor_gain"),
        (("-o", "m.yaml", "--lines-hz", "800"), "announced frequency"),
        (("-o", "m.yaml", "--lines-hz", "20", "--lines-error-hz", "-1"), "must be at least 0"),
        (("-o", "m.yaml", "--lines-file", "none.txt"), "cannot read"),
        (("-o", "m.yaml", "--accelerometers", "none.npy"), "cannot read"),
        (("-o", "m.yaml", "--most-lines", "-1"), "most_lines"),
        (("-o", "m.yaml", "--wavelength-um", "0"), "wavelength_um"),
        (("-o", "m.yaml", "--kind", "spectrum"), "kind"),
    ],
)
def test_bad_requests_are_refused(tmp_path, capsys, monkeypatch, night, options, words):
    monkeypatch.chdir(tmp_path)
    status, text, error = run(capsys, "identify", night, *options)
    assert (status, text) == (2, "")
    assert words in error
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


def test_a_short_record_is_refused_with_the_length_it_needs(tmp_path, capsys):
    np.save(tmp_path / "y.npy", np.random.default_rng(0).standard_normal(900))
    for command, output in (("identify", "m.yaml"), ("auto", "t.fits")):
        status, _, error = run(
            capsys,
            command,
            tmp_path / "y.npy",
            "-o",
            tmp_path / output,
            "--kind",
            "open-loop",
            "--frame-rate-hz",
            500,
            "--delay-frames",
            2,
            "--unit",
            "nm",
        )
        assert status == 2
        assert "needs 4096 usable frames" in error


def test_auto_refuses_what_it_cannot_do(tmp_path, capsys, night):
    for options, words in (
        (("-o", tmp_path / "t.fits", "--gamma-ratio", 0.5), "gamma_ratio"),
        (("-o", tmp_path / "t.txt"), "must end in"),
        (("-o", tmp_path / "t.fits", "--model", tmp_path / "t.fits"), "must end in .yaml"),
        (("-o", tmp_path / "t.fits", "--model", tmp_path / "t.json"), "must end in .yaml"),
    ):
        status, _, error = run(capsys, "auto", night, *options)
        assert status == 2
        assert words in error
    assert list(tmp_path.iterdir()) == []


def test_design_from_record_needs_a_delay_and_data():
    noise = np.random.default_rng(0).standard_normal((9000, 1))
    with pytest.raises(lbt.errors.ProblemError, match="needs the delay"):
        lbt.design_from_record(
            lbt.identification.loop_record(noise, noise, frame_rate_hz=RATE, unit="nm")
        )
    with pytest.raises(lbt.errors.ProblemError, match="LoopRecord"):
        lbt.design_from_record(noise)
    short = lbt.identification.loop_record(
        noise[:900], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    with pytest.raises(lbt.errors.ProblemError, match="4096"):
        lbt.design_from_record(short)
    with pytest.raises(lbt.errors.ProblemError, match="method"):
        lbt.design_from_record(short, method="magic")
