"""The command identify: good records, and bad ones."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.commands import run
from support.night import GAIN, LINE_HZ
from support.recorded_loops import RATE, open_record

import lbt_synth as lbt
from lbt_synth.cli import identify as identify_command
from lbt_synth.identification.fit import whittle

FACTS = ("--frame-rate-hz", 1000, "--delay-frames", 2, "--unit", "nm")


@pytest.fixture(scope="module")
def tip_night(recorded_loop, tmp_path_factory):
    """The axis of the recorded night that vibrates, alone."""
    file = tmp_path_factory.mktemp("tip") / "tip.npz"
    run_, _, _ = recorded_loop
    y, u = (series[0, :, :1] for series in (run_.measurements, run_.commands))
    np.savez(file, measurements=y, commands=u)
    return file


@pytest.fixture(scope="module")
def brief_night(recorded_loop, tmp_path_factory):
    """The telemetry of the first five seconds."""
    run_, path, ran = recorded_loop
    seen = lbt.files.telemetry_from_simulation(run_, path, sensor_gain=GAIN, design=ran)
    names = ("commands", "measurements", "residual_nm", "total_nm")
    brief = replace(seen, **{name: getattr(seen, name)[:5000] for name in names})
    return lbt.files.save_telemetry(tmp_path_factory.mktemp("brief") / "brief.fits", brief)


def test_identify_writes_a_configuration_that_designs(tmp_path, capsys, recorded_night):
    out = tmp_path / "model.yaml"
    status, text, error = run(
        capsys, "identify", recorded_night, "-o", out, "--wavelength-um", 1.65
    )
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


@pytest.mark.parametrize("ending", ["npy", "npz", "csv", "fits"])
def test_series_of_any_format(tmp_path, capsys, recorded_loop, ending):
    run_, _, _ = recorded_loop
    y, u = run_.measurements[0, :6000], run_.commands[0, :6000]
    file = tmp_path / f"night.{ending}"
    options: tuple[object, ...] = FACTS
    if ending == "npy":
        np.save(file, np.hstack([y, u]))
        options += ("--columns", "measurements=0,1", "commands=2,3")
    elif ending == "npz":
        np.savez(file, measurements=y, commands=u)
    elif ending == "csv":
        options += ("--columns", "times=")  # they stand still
        np.savetxt(
            file,
            np.hstack([np.zeros((len(y), 1)), y, u]),
            delimiter=",",
            comments="",
            header="time,tip_nm,tilt_nm,command_tip_nm,command_tilt_nm",
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


def test_a_line_along_a_diagonal_is_one_row(tmp_path, capsys):
    line = lbt.Vibration(frequency_hz=31, damping=0.006, rms_nm=60, direction=(0.8, -0.6))
    file = tmp_path / "night.npy"
    np.save(file, open_record(((line, 0),), frames=8192).measurements)
    options = ("--columns", "measurements=0,1", "--frame-rate-hz", 1000, "--unit", "nm")
    options += ("--kind", "open-loop", "--no-figure", "-o", tmp_path / "m.yaml")
    status, text, _ = run(capsys, "identify", file, *options)
    assert status == 0
    (row,) = [row for row in text.splitlines() if "+- 0.1 deg" in row]
    assert float(row.split()[0]) == pytest.approx(-36.87, abs=0.5)
    assert float(row.split()[4]) == pytest.approx(31, abs=0.3)
    status, text, _ = run(capsys, "identify", file, *options, "--json")
    (found,) = json.loads(text)["vibrations"]
    assert found["direction"] == pytest.approx([0.8, -0.6], abs=0.01)


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
    stated = ("--kind", "spectrum", "--noise-nm", 7, "-o", tmp_path / "n.yaml", "--no-figure")
    status, _, error = run(capsys, "identify", file, *options, *stated)
    assert (status, error) == (0, "")
    assert np.diag(lbt.load_config(tmp_path / "n.yaml").plant.R) == pytest.approx(49)
    status, _, error = run(
        capsys, "auto", file, "-o", tmp_path / "t.fits", *options, "--kind", "spectrum"
    )
    assert status == 2
    assert "got a spectrum" in error


def test_lists_announce_lines(tmp_path, capsys, recorded_night):
    (tmp_path / "plain.txt").write_text("31.0 0.1\n")
    (tmp_path / "named.csv").write_text("error_hz,frequency_hz\n0.1,31.0\n,77\n")
    for options in (
        ("--lines-file", tmp_path / "plain.txt"),
        ("--lines-file", tmp_path / "named.csv"),
        ("--lines-hz", 31, 77),
    ):
        status, text, error = run(
            capsys,
            "identify",
            recorded_night,
            "-o",
            tmp_path / "m.yaml",
            "--no-figure",
            "--json",
            *options,
        )
        assert (status, error) == (0, "")
        (line,) = json.loads(text)["axes"][0]["vibrations"]
        assert line["announced"]
        assert line["frequency_hz"] == pytest.approx(LINE_HZ, abs=0.2)


@pytest.mark.parametrize(
    "text",
    [
        "frequency_hz,error_hz\n20,0.1\n,0.2\n",
        "f_hz,frequency_hz\n20,20\n",
        "error_hz\n20\n",
        "1,2,3\n",
    ],
)
def test_lists_of_lines_that_are_refused(tmp_path, capsys, recorded_night, text):
    (tmp_path / "lines.csv").write_text(text)
    options = ("-o", tmp_path / "m.yaml", "--lines-file", tmp_path / "lines.csv")
    status, _, error = run(capsys, "identify", recorded_night, *options)
    assert status == 2
    assert "must have a frequency_hz in each row" in error


def test_accelerometers_are_compared_with_the_lines_of_the_model(
    tmp_path, capsys, recorded_loop, tip_night
):
    """Two readings a frame in mm/s^2: a channel that follows the line twofold, and a dead one."""
    run_, _, _ = recorded_loop
    shake = np.diff(run_.total_nm[0][:, 0], n=2, prepend=[0, 0])  # mm/s^2 at 1 kHz
    readings = 2 * shake + 0.05 * np.std(shake) * np.random.default_rng(4).standard_normal(
        shake.size
    )
    table = np.column_stack([readings, np.zeros(shake.size)]).repeat(2, axis=0)
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="m1,m2", comments="")
    base = ("identify", tip_night, *FACTS, "-o", tmp_path / "m.yaml", "--no-figure")
    own = ("--accelerometers", tmp_path / "a.csv", "--acceleration-unit", "mm/s2")
    status, text, error = run(capsys, *base, *own, "--accelerometer-rate-hz", 2000, "--json")
    assert (status, error) == (0, "")
    found = json.loads(text)
    (line,) = [row for row in found["accelerometer_lines"] if row["useful"]]
    assert (line["channel"], found["vibrations"][line["line"]]["kind"]) == ("m1", "line")
    assert line["motion_nm_per_nm"] == pytest.approx(2, rel=0.05)
    assert [row["verdict"] for row in found["accelerometers"]] == [
        "used",
        "dead",
    ]
    settings = lbt.load_config(tmp_path / "m.yaml").settings
    assert settings.sensors["accelerometer"].channels == ["m1"]
    (moving,) = [each.accelerometers for each in settings.model.vibrations if each.accelerometers]
    assert moving["m1"].motion_nm_per_nm == line["motion_nm_per_nm"]
    status, text, error = run(capsys, *base, *own, "--accelerometer-rate-hz", 1500)
    assert status == 0  # a rate that is wrong shows no line
    assert "check the rate of the readings" in text
    status, text, error = run(capsys, *base, *own, "--accelerometer-rate-hz", 500)
    assert status == 2
    assert "at least once a frame, 1000 Hz, and last a frame; got 24000 readings at 500 Hz" in error


def test_a_model_is_written_whatever_becomes_of_its_accelerometers(
    tmp_path, capsys, monkeypatch, recorded_loop, tip_night
):
    run_, _, _ = recorded_loop
    np.save(tmp_path / "a.npy", 1e-3 * np.diff(run_.total_nm[0][:, 0], n=2, prepend=[0, 0]))
    real = identify_command.accelerometer_transfers

    def fails(*_, **__):
        raise lbt.errors.NumericalError("gone.")

    def is_noiseless(*given, **options):
        found = real(*given, **options)
        rows = tuple(replace(row, noise_m_s2=0.0) for row in found.channels)
        return replace(found, channels=rows)

    for wrong, words in (
        (fails, "warning: the accelerometers were not compared: gone."),
        (is_noiseless, "warning: the model is written without accelerometers: "),
    ):
        monkeypatch.setattr(identify_command, "accelerometer_transfers", wrong)
        out = tmp_path / f"{wrong.__name__}.yaml"
        base = ("identify", tip_night, *FACTS, "-o", out, "--no-figure")
        status, text, _ = run(capsys, *base, "--accelerometers", tmp_path / "a.npy")
        assert status == 0
        assert words in text
        settings = lbt.load_config(out).settings
        assert settings.sensors is None
        assert settings.model.vibrations


def test_faults_are_in_the_report(tmp_path, capsys, recorded_loop):
    run_, _, _ = recorded_loop
    y, u = run_.measurements[0].copy(), run_.commands[0]
    y[5000:5400] = np.nan
    y[8000] = np.nan
    np.savez(tmp_path / "n.npz", measurements=y, commands=u)
    options = (*FACTS, "--no-figure")
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
        (
            ("-o", "m.yaml", "--sensor-gain", "1", "2", "3"),
            "one number, or one per measurement (2)",
        ),
        (("-o", "m.yaml", "--sensor-gain", "0"), "--sensor-gain must be"),
        (("-o", "m.yaml", "--lines-hz", "800"), "announced frequency"),
        (("-o", "m.yaml", "--lines-hz", "20", "--lines-error-hz", "-1"), "must be at least 0"),
        (("-o", "m.yaml", "--lines-file", "none.txt"), "cannot read"),
        (("-o", "m.yaml", "--accelerometers", "none.npy"), "cannot read"),
        (("-o", "m.yaml", "--acceleration-unit", "g"), "goes with --accelerometers"),
        (("-o", "m.yaml", "--most-lines", "-1"), "--most-lines must be"),
        (("-o", "m.yaml", "--wavelength-um", "0"), "--wavelength-um must be above 0"),
        (("-o", "m.yaml", "--kind", "spectrum"), "kind"),
    ],
)
def test_bad_requests_are_refused(tmp_path, capsys, monkeypatch, brief_night, options, words):
    monkeypatch.chdir(tmp_path)
    status, text, error = run(capsys, "identify", brief_night, *options)
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
        assert f"needs {1024 if command == 'identify' else 2000} usable frames" in error


def test_a_sinusoid_without_noise_is_no_crash(tmp_path, capsys, monkeypatch) -> None:
    evaluations = []
    plain = whittle.derivatives
    monkeypatch.setattr(
        whittle, "derivatives", lambda *given: evaluations.append(0) or plain(*given)
    )
    series = 100 * np.sin(2 * np.pi * 0.05 * np.arange(8192))
    np.save(tmp_path / "s.npy", series)
    status, _, error = run(
        capsys,
        "identify",
        tmp_path / "s.npy",
        "--kind",
        "open-loop",
        "--unit",
        "nm",
        "--frame-rate-hz",
        1000,
        "-o",
        tmp_path / "s.yaml",
        "--no-figure",
    )
    assert status in (0, 2)
    assert "Traceback" not in error
    assert 0 < len(evaluations) < 10_000  # the search ends
