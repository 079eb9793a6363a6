"""The commands identify, auto and diagnose: good records, and bad ones."""

import re

import numpy as np
import pytest
from support.commands import refuse_commands, run, run_done, run_json
from support.diagnoses import given_design, line_record
from support.night import GAIN, LINE_HZ, NOISE, simulated_night
from support.recorded_loops import RATE, spliced_record

import lbt_synth as lbt
from lbt_synth.identification.fit import whittle

FACTS = ("--frame-rate-hz", 1000, "--delay-frames", 2, "--unit", "nm")


def save_series(path, y, u):
    np.savez(path, measurements=y, commands=u)
    return path


@pytest.fixture(scope="module")
def tip_night(tmp_path_factory):
    run = simulated_night()[0]
    path = tmp_path_factory.mktemp("tip") / "tip.npz"
    return save_series(path, run.measurements[0, :, :1], run.commands[0, :, :1])


def test_identify_writes_a_configuration_that_designs(tmp_path, capsys, recorded_night):
    out = tmp_path / "model.yaml"
    text = run_done(capsys, "identify", recorded_night, "-o", out, "--wavelength-um", 1.65)
    assert text.startswith("1 vibration, the strongest of ")
    evidence = r"tells 1 component from 0 by at most \d+ and from 2 by about \d+ units"
    assert re.search(evidence, " ".join(text.split()))
    assert "\nVibrations\n" in text
    assert out.with_suffix(".png").stat().st_size > 10_000
    config = lbt.load_config(out)
    (line,) = config.plant.vibrations
    assert line.frequency_hz == pytest.approx(LINE_HZ, abs=0.2)
    assert line.direction == (1.0, 0.0)
    assert config.imaging.wavelength_um == 1.65
    assert config.settings.model.sensor_gain == pytest.approx([GAIN, GAIN], rel=0.15)
    assert config.design("kalman").certificate.passed


def test_a_spectrum(tmp_path, capsys):
    f = np.arange(1, 1600) * 0.25
    facts = ((2.7, 0.1, 100), (52, 0.02, 30))  # Hz, damping ratio, nm
    slow, line = (lbt.Vibration(frequency_hz=a, damping=b, rms_nm=c) for a, b, c in facts)
    smooth = slow.ar_model(RATE).psd(f) + line.ar_model(RATE).psd(f) + 0.5
    density = smooth * np.random.default_rng(0).gamma(20.0, 1 / 20.0, f.size)
    file, model = tmp_path / "psd.csv", tmp_path / "m.yaml"
    header = {"comments": "", "header": "frequency_hz,psd_nm2/Hz"}
    np.savetxt(file, np.column_stack([f, density]), delimiter=",", **header)
    facts = (*FACTS[:-1], "nm^2/Hz", "--no-figure", "--noise-nm", 7)
    run_done(capsys, "identify", file, *facts, "-o", model)
    config = lbt.load_config(model)
    (line,) = config.plant.vibrations
    assert config.hardware.frame_rate_hz == 1000
    assert line.frequency_hz == pytest.approx(52, abs=0.3)
    assert np.diag(config.plant.R) == pytest.approx(49)
    text = run_done(capsys, "identify", file, *facts, "-o", model, "--lowest-line-hz", 60)
    assert text.startswith("No vibration stands out")  # it is a part of the turbulence


def test_accelerometers_are_compared_with_the_lines_of_the_model(tmp_path, capsys, tip_night):
    """Two readings a frame in mm/s^2: a channel that follows the line twofold, and a dead one."""
    total_nm = simulated_night()[0].total_nm[0][:, 0]
    shake = np.diff(total_nm, n=2, prepend=[0, 0])  # mm/s^2 at 1 kHz
    noise = 0.05 * np.std(shake) * np.random.default_rng(4).standard_normal(shake.size)
    table = np.column_stack([2 * shake + noise, np.zeros(shake.size)]).repeat(2, axis=0)
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="m1,m2", comments="")
    words = ("identify", tip_night, *FACTS, "-o", tmp_path / "m.yaml", "--no-figure")
    words += ("--accelerometers", tmp_path / "a.csv", "--acceleration-unit", "mm/s2")
    words += ("--accelerometer-rate-hz",)
    data = run_json(capsys, *words, 2000)
    (line,) = [row for row in data["accelerometer_lines"] if row["useful"]]
    assert (line["channel"], data["vibrations"][line["line"]]["kind"]) == ("m1", "line")
    assert line["motion_nm_per_nm"] == pytest.approx(2, rel=0.05)
    assert [row["verdict"] for row in data["accelerometers"]] == ["used", "dead"]
    settings = lbt.load_config(tmp_path / "m.yaml").settings
    assert settings.sensors["accelerometer"].channels == ["m1"]
    text = run_done(capsys, *words, 1500, "--verbose")  # a rate that is wrong shows no line
    assert "check the rate of the readings" in text
    slow = "at least once a frame, 1000 Hz, and last a frame; got 24000 readings at 500 Hz"
    refuse_commands(capsys, [(" ".join(map(str, (*words, 500))), slow)])


def test_faults_are_in_the_report(tmp_path, capsys):
    run = simulated_night()[0]
    y = run.measurements[0].copy()
    y[5000:5400] = y[8000] = np.nan
    file = save_series(tmp_path / "a\x01.npz", y, run.commands[0])
    model = tmp_path / "m.yaml"
    text = run_done(capsys, "identify", file, "-o", model, *FACTS, "--no-figure")
    assert re.search(r"(?s)note: \d+ of \d+ frames are usable.*not finite", text)
    assert "a\\x01.npz" in model.read_text()  # what no text can hold


def test_a_sinusoid_without_noise_is_no_crash(tmp_path, capsys, monkeypatch):
    evaluations, plain = [], whittle.derivatives
    counted = lambda *given: evaluations.append(0) or plain(*given)  # noqa: E731
    monkeypatch.setattr(whittle, "derivatives", counted)
    np.save(tmp_path / "s.npy", 100 * np.sin(2 * np.pi * 0.05 * np.arange(2048)))
    words = ("--columns", "open_loop=0", "--no-figure", "-o", tmp_path / "s.yaml", *FACTS)
    assert run(capsys, "identify", tmp_path / "s.npy", *words)[0] in (0, 2)
    assert 0 < len(evaluations) < 10_000  # the search ends


def test_auto_tests_its_design_on_unseen_data(tmp_path, capsys, recorded_night):
    out = tmp_path / "tt.fits"
    data = run_json(capsys, "auto", recorded_night, "-o", out)
    rows = {row["name"]: row for row in data["held_out"]}
    names = "what ran/best integrator/Kalman filter/H-infinity filter/LQG controller/"
    assert list(rows) == (names + "least-squares predictor/limit of performance").split("/")
    left = {name: row["data_nm"] for name, row in rows.items()}
    kalman = left["Kalman filter"]
    assert kalman < min(0.5 * left["what ran"], 1.02 * left["least-squares predictor"])
    assert kalman == pytest.approx(rows["Kalman filter"]["model_nm"], rel=0.1)
    # what ran is what the simulation left in its second half
    half = np.split(simulated_night()[0].residual_nm[0], 2)[1]
    true = np.sqrt(np.sum(np.mean(half**2, axis=0)))
    tip, tilt = data["axes"]
    assert left["what ran"] == pytest.approx(true * GAIN / tip["sensor_gain"], rel=0.05)
    assert data["gain_over_what_ran"]["residual_nm"][1] == kalman
    assert (data["certificate"], data["method"]) == (True, "kalman")
    assert tip["over_fewer"] > tip["over_more"] > 0
    assert tilt["over_fewer"] is None  # without a component
    assert data["units"]["data_error_nm"] == "nm"
    assert lbt.load_gain(out).certificate.passed
    assert data["files"] == [str(out.with_suffix(ending)) for ending in (".fits", ".yaml", ".png")]
    assert lbt.load_config(data["files"][1]).plant.vibrations
    assert out.with_suffix(".png").is_file()
    out.unlink()  # the model may be another's now
    assert "tt.yaml would be replaced" in run(capsys, "auto", recorded_night, "-o", out)[2]


def test_auto_separates_axes_and_says_what_that_costs(tmp_path, capsys, recorded_night):
    words = ("--separate-axes", "--method", "kalman", "--no-figure", "-o", tmp_path / "k.fits")
    *_, row = run_json(capsys, "auto", recorded_night, *words)["held_out"]
    assert row["name"] == "Kalman filter, axes mixed"
    assert row["data_nm"] > 0


def test_an_open_loop_series_and_one_axis(tmp_path, capsys):
    total_nm = simulated_night()[0].total_nm[0][:, 0]
    noise = np.random.default_rng(0).standard_normal(len(total_nm))
    np.save(tmp_path / "open.npy", total_nm + NOISE * noise)
    words = ("--columns", "open_loop=0", "--no-figure", "-o", tmp_path / "t.fits", *FACTS)
    text = run_done(capsys, "auto", tmp_path / "open.npy", *words)
    assert "what ran" not in text
    assert "note: the Kalman filter stays: " in text
    assert lbt.load_config(tmp_path / "t.yaml").plant.hardware.modes == 1
    assert not (tmp_path / "t.png").exists()


def test_a_residual_that_the_noise_hides_has_a_bound(tmp_path, capsys):
    np.save(tmp_path / "noise.npy", 300 * np.random.default_rng(1).standard_normal(5000))
    words = ("--columns", "open_loop=0", "--no-figure", "-o", tmp_path / "t.fits", *FACTS)
    data = run_json(capsys, "auto", tmp_path / "noise.npy", *words)
    (row,) = (row for row in data["held_out"] if row["name"] == "Kalman filter")
    assert row["data_nm"] is row["strehl"] is None
    assert "leaves at most 76 nm (the noise hides it) on unseen data." in data["verdict"][0]


def test_several_nights_make_one_design_and_a_table(tmp_path, capsys) -> None:
    files = []
    for seed, hz in enumerate((29.0, 33.0)):
        record = spliced_record((seed,), lines=((hz, 0.004, 60.0),), frames=9000)
        path = tmp_path / f"night{seed}.npz"
        files.append(save_series(path, record.measurements, record.commands))
    words = ("auto", *files, *FACTS, "--sensor-gain", 0.6, "--command-scale", 1)
    data = run_json(capsys, *words, "-o", tmp_path / "robust.fits")
    assert (data["written"], data["certificate"]) == ("all nights", True)
    table = {row["design"]: row for row in data["nights"]}
    assert list(table) == ["night0.npz", "night1.npz", "all nights"]
    assert "that of night0.npz leaves " in data["verdict"][0]
    assert data["units"]["night0.npz"] == "nm"
    assert data["assumptions"][0].endswith("were read with --command-scale 1")
    assert "night1.npz: the sensor gain is 0.6, as it was given" in data["assumptions"]
    assert lbt.load_gain(tmp_path / "robust.fits").certificate.passed
    assert sorted(tmp_path.iterdir()) == [*files, tmp_path / "robust.fits"]


def test_a_gain_file_the_page_and_json(capsys, tmp_path):
    record = line_record()
    night = save_series(tmp_path / "night.npz", record.measurements, record.commands)
    gain, page = lbt.save_gain(tmp_path / "mine.npz", given_design()), tmp_path / "page.html"
    data = run_json(capsys, "diagnose", night, gain, *FACTS, "-o", page)
    assert (data["doubt"], data["law"][0]["law"]) == (None, "integrator")
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
    path = save_series(tmp_path / "dead.npz", y, np.hstack([record.commands] * 2))
    text = run_done(capsys, "diagnose", path, *FACTS)
    assert text.startswith("The record has faults: the tilt measurement is dead. It leaves ")
    assert "note: the rest is of the axis that lives: the other one is dead" in text


def test_auto_says_what_accelerometers_buy(tmp_path, capsys, tip_night):
    shake = 1e-3 * np.diff(simulated_night()[0].total_nm[0][:, 0], n=2, prepend=[0, 0])
    np.save(tmp_path / "a.npy", shake)
    words = ("auto", tip_night, *FACTS, "--accelerometers", tmp_path / "a.npy", "--no-figure")
    words += ("--method", "predictor", "-o", tmp_path / "p.fits")
    data, claims = run_json(capsys, *words), lbt.load_gain(tmp_path / "p.fits").claims
    bought = f"That is {claims['residual_nm']:.3g} nm with the accelerometers, "
    assert f"{bought}{claims['alone_nm']:.3g} nm without them." in data["verdict"]
    assert "the sensor gain lies within" in data["assumptions"][0]
    (channel,) = data["accelerometers"]
    assert channel["without_nm"] > claims["residual_nm"]
