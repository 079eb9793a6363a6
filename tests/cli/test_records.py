"""The commands identify, auto and diagnose: good records, and bad ones."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from support.commands import run
from support.diagnoses import given_design, line_record
from support.night import GAIN, LINE_HZ, NOISE
from support.recorded_loops import RATE, spliced_record

import lbt_synth as lbt
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


def test_identify_writes_a_configuration_that_designs(tmp_path, capsys, recorded_night):
    out = tmp_path / "model.yaml"
    status, text, error = run(
        capsys, "identify", recorded_night, "-o", out, "--wavelength-um", 1.65
    )
    assert (status, error) == (0, "")
    assert text.startswith("1 vibration, the strongest of ")
    told = r"tells 1 component from 0 by at most \d+ and from 2 by about \d+ units"
    assert re.search(told, " ".join(text.split()))
    assert "\nVibrations\n" in text
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
    status, _, error = run(capsys, "identify", file, "-o", tmp_path / "m.yaml", *options)
    assert (status, error) == (0, "")
    config = lbt.load_config(tmp_path / "m.yaml")
    assert config.hardware.frame_rate_hz == 1000
    assert config.plant.vibrations[0].frequency_hz == pytest.approx(52, abs=0.3)
    stated = ("--noise-nm", 7, "-o", tmp_path / "n.yaml", "--no-figure")
    status, _, error = run(capsys, "identify", file, *options, *stated)
    assert (status, error) == (0, "")
    assert np.diag(lbt.load_config(tmp_path / "n.yaml").plant.R) == pytest.approx(49)
    status, _, error = run(capsys, "auto", file, "-o", tmp_path / "t.fits", *options)
    assert status == 2
    assert "got a spectrum" in error


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
    assert [row["verdict"] for row in found["accelerometers"]] == ["used", "dead"]
    settings = lbt.load_config(tmp_path / "m.yaml").settings
    assert settings.sensors["accelerometer"].channels == ["m1"]
    (moving,) = [each.accelerometers for each in settings.model.vibrations if each.accelerometers]
    assert moving["m1"].motion_nm_per_nm == line["motion_nm_per_nm"]
    status, text, error = run(capsys, *base, *own, "--accelerometer-rate-hz", 1500, "--verbose")
    assert status == 0  # a rate that is wrong shows no line
    assert "check the rate of the readings" in text
    status, text, error = run(capsys, *base, *own, "--accelerometer-rate-hz", 500)
    assert status == 2
    assert "at least once a frame, 1000 Hz, and last a frame; got 24000 readings at 500 Hz" in error


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
    assert re.search(r"note: \d+ of \d+ frames are usable", text)
    assert "not finite" in text


def test_a_sinusoid_without_noise_is_no_crash(tmp_path, capsys, monkeypatch) -> None:
    evaluations = []
    plain = whittle.derivatives
    monkeypatch.setattr(
        whittle, "derivatives", lambda *given: evaluations.append(0) or plain(*given)
    )
    np.save(tmp_path / "s.npy", 100 * np.sin(2 * np.pi * 0.05 * np.arange(8192)))
    words = ("--columns", "open_loop=0", "--no-figure", "-o", tmp_path / "s.yaml", *FACTS)
    status, _, error = run(capsys, "identify", tmp_path / "s.npy", *words)
    assert status in (0, 2)
    assert "Traceback" not in error
    assert 0 < len(evaluations) < 10_000  # the search ends


@pytest.fixture(scope="module")
def made(recorded_night, tmp_path_factory):
    """Everything that auto writes, and what it says."""
    import contextlib
    import io

    from lbt_synth.cli.main import main

    out = tmp_path_factory.mktemp("auto") / "tt.fits"
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        assert main(["auto", str(recorded_night), "-o", str(out), "--json"]) == 0
    return out, json.loads(text.getvalue())


def test_auto_tests_its_design_on_unseen_data(made, recorded_loop):
    out, data = made
    rows = {row["name"]: row for row in data["held_out"]}
    assert list(rows) == [
        "what ran",
        "best integrator",
        "Kalman filter",
        "H-infinity filter",
        "LQG controller",
        "least-squares predictor",
        "limit of performance",
    ]
    kalman = rows["Kalman filter"]
    assert kalman["data_nm"] < 0.5 * rows["what ran"]["data_nm"]
    assert kalman["data_nm"] < 1.02 * rows["least-squares predictor"]["data_nm"]
    assert kalman["data_nm"] == pytest.approx(kalman["model_nm"], rel=0.1)
    # what ran is what the simulation left in its second half
    run_, _, _ = recorded_loop
    half = run_.residual_nm[0, len(run_.residual_nm[0]) // 2 :]
    true = np.sqrt(np.sum(np.mean(half**2, axis=0)))
    gain = data["axes"][0]["sensor_gain"]
    assert rows["what ran"]["data_nm"] == pytest.approx(true * GAIN / gain, rel=0.05)
    assert data["gain_over_what_ran"]["residual_nm"][1] == kalman["data_nm"]
    assert data["certificate"] is True
    assert data["axes"][0]["over_fewer"] > data["axes"][0]["over_more"] > 0
    assert data["axes"][1]["over_fewer"] is None  # without a component
    assert data["method"] == "kalman"
    assert data["units"]["data_error_nm"] == "nm"
    assert lbt.load_gain(out).certificate.passed
    assert lbt.load_config(data["model"]).plant.vibrations
    assert out.with_suffix(".png").is_file()


def test_auto_says_what_it_found(capsys, recorded_night, tmp_path):
    options = ("--method", "hinf", "--sensor-gain", GAIN, "--no-figure")
    files = ("-o", tmp_path / "h.npz")
    status, text, error = run(capsys, "auto", recorded_night, *options, *files)
    assert (status, error) == (0, "")
    said = " ".join(text.split())
    assert re.match(
        r"The H-infinity filter leaves [\d.]+ nm rms on unseen data, where what ran left [\d.]+ nm",
        said,
    )
    assert "Kalman filter" not in text
    assert not (tmp_path / "h.png").exists()
    assert (tmp_path / "h.yaml").is_file()


def test_an_open_loop_series_and_one_axis(tmp_path, capsys, recorded_loop):
    run_, _, _ = recorded_loop
    noise = np.random.default_rng(0).standard_normal(len(run_.total_nm[0]))
    np.save(tmp_path / "open.npy", run_.total_nm[0][:, 0] + NOISE * noise)
    words = ("--columns", "open_loop=0", "--no-figure", "-o", tmp_path / "t.fits", *FACTS)
    status, text, error = run(capsys, "auto", tmp_path / "open.npy", *words)
    assert (status, error) == (0, "")
    assert "what ran" not in text
    assert "note: the Kalman filter stays: " in text
    assert lbt.load_config(tmp_path / "t.yaml").plant.hardware.modes == 1


def test_names_that_no_text_can_hold(tmp_path, capsys) -> None:
    record = spliced_record(frames=9000)
    file = tmp_path / "a\x01.npz"
    np.savez(file, measurements=record.measurements, commands=record.commands)
    words = ("auto", file, "-o", tmp_path / "q.fits", *FACTS, "--no-figure")
    status, _, error = run(capsys, *words)
    assert (status, error) == (0, "")
    assert "a\\x01.npz" in (tmp_path / "q.yaml").read_text()


def test_several_nights_make_one_design_and_a_table(tmp_path, capsys) -> None:
    for seed, hz in enumerate((29.0, 33.0)):
        record = spliced_record((seed,), lines=((hz, 0.004, 60.0),), frames=9000)
        file = tmp_path / f"night{seed}.npz"
        np.savez(file, measurements=record.measurements, commands=record.commands)
    words = ("auto", tmp_path / "night0.npz", tmp_path / "night1.npz", *FACTS)
    status, text, error = run(capsys, *words, "-o", tmp_path / "robust.fits", "--json")
    assert (status, error) == (0, "")
    data = json.loads(text)
    assert (data["written"], data["certificate"]) == ("all nights", True)
    table = {row["design"]: row for row in data["nights"]}
    assert list(table) == ["night0.npz", "night1.npz", "all nights"]
    own = table["night1.npz"]["night1.npz"]
    ratio = (table["night0.npz"]["night1.npz"] / own) ** 2
    assert table["night0.npz"]["worst_ratio"] == pytest.approx(ratio)
    assert f"that of night0.npz leaves {ratio:.2f} times the variance" in data["verdict"][0]
    assert data["units"]["night0.npz"] == "nm"
    assert lbt.load_gain(tmp_path / "robust.fits").certificate.passed
    assert sorted(p.name for p in tmp_path.iterdir()) == ["night0.npz", "night1.npz", "robust.fits"]
    status, _, error = run(capsys, *words, "--commands", "u.npy", "-o", tmp_path / "no.fits")
    assert (status, "--commands is for one record." in error) == (2, True)
    status, _, error = run(capsys, *words[:2], *words[1:], "-o", tmp_path / "no.fits")
    assert status == 2
    assert "each record must have a name of its own; got night0.npz, night0.npz" in error
    np.savez(tmp_path / "night1.npz", measurements=record.measurements[:2000])
    status, _, error = run(capsys, *words, "-o", tmp_path / "no.fits")
    assert status == 2
    assert "night1.npz" in error


def write(path, change=1.0, frames=None, **more):
    record = line_record()
    y, u = record.measurements[:frames], record.commands[:frames]
    np.savez(path, measurements=y, commands=change * u, **more)
    return path


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    return write(tmp_path_factory.mktemp("records") / "night.npz")


def test_a_gain_file_the_page_and_json(capsys, night, tmp_path):
    gain = lbt.save_gain(tmp_path / "mine.npz", given_design())
    page = tmp_path / "page.html"
    status, text, error = run(capsys, "diagnose", night, gain, *FACTS, "-o", page, "--json")
    assert (status, error) == (0, "")
    data = json.loads(text)
    assert data["doubt"] is None
    assert data["law"][0]["law"] == "integrator"
    assert any(note.startswith("mine assumes") for note in data["notes"])
    assert {row["name"] for row in data["residuals"]} > {"mine", data["best"], "what ran"}
    assert data["costs"][-1]["part"] == "all"
    assert data["lines"][0]["frequency_hz"] == pytest.approx(31, abs=0.2)
    assert data["verdict"][0].startswith("The record is sound")
    assert data["files"] == [str(page)]
    assert "Diagnosis of night.npz" in page.read_text(encoding="utf-8")


def test_a_dead_axis_leaves_the_other(capsys, tmp_path):
    record = line_record()
    y = np.hstack([record.measurements, np.zeros((record.frames, 1))])
    path = tmp_path / "dead.npz"
    np.savez(path, measurements=y, commands=np.hstack([record.commands] * 2))
    status, text, _ = run(capsys, "diagnose", path, *FACTS)
    assert status == 0
    assert text.startswith("The record has faults: the tilt measurement is dead. It leaves ")
    assert "note: the rest is of the axis that lives: the other one is dead" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("identify NIGHT -o m.txt", "must end in .yaml"),
        ("identify NIGHT -o m.yaml --columns a", "--columns takes ROLE=NAME or ROLE=NAME,NAME"),
        ("identify NIGHT -o m.yaml --acceleration-unit g", "goes with --accelerometers."),
        ("identify NIGHT -o m.yaml --obstruction 0.1", "give --diameter-m."),
        ("auto SHORT -o t.fits --delay-frames 2", "4 s at 1000 Hz) in stretches of at least 256"),
        ("diagnose NIGHT --pdf a.pdf", "--pdf is the page of -o on paper; give -o, too."),
        ("diagnose PSD.csv --unit nm^2/Hz", "diagnose examines recorded series; "),
    ],
)
def test_bad_requests_are_refused(tmp_path, capsys, monkeypatch, recorded_night, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "PSD.csv").write_text(
        "frequency_hz,psd\n" + "".join(f"{i},1\n" for i in range(1, 99))
    )
    short = tmp_path / "short.npz"
    record = spliced_record(frames=3000)
    np.savez(short, measurements=record.measurements, commands=record.commands)
    files = {"NIGHT": [recorded_night], "SHORT": [short, *FACTS[:2], *FACTS[4:]]}
    before = sorted(tmp_path.iterdir())
    status, text, error = run(capsys, *(w for one in words.split() for w in files.get(one, [one])))
    assert (status, text, error.count("\n")) == (2, "", 1)
    assert message in error
    assert sorted(tmp_path.iterdir()) == before


def test_auto_says_what_accelerometers_buy(tmp_path, capsys, recorded_loop, tip_night):
    shake = 1e-3 * np.diff(recorded_loop[0].total_nm[0][:, 0], n=2, prepend=[0, 0])
    np.save(tmp_path / "a.npy", shake)
    words = ("auto", tip_night, *FACTS, "--accelerometers", tmp_path / "a.npy", "--no-figure")
    words += ("--method", "predictor", "-o", tmp_path / "p.fits")
    status, text, error = run(capsys, *words)
    assert (status, error) == (0, "")
    claims = lbt.load_gain(tmp_path / "p.fits").claims
    bought = f"That is {claims['residual_nm']:.3g} nm with the accelerometers, "
    bought += f"{claims['alone_nm']:.3g} nm without them."
    assert bought in " ".join(text.split())
    assert "\nassumes: the sensor gain lies within" in text
    (channel,) = json.loads(run(capsys, *words, "--json")[1])["accelerometers"]
    assert channel["without_nm"] > claims["residual_nm"]
