"""The command robustness, without and with gain files."""

import csv
import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from support.commands import run
from support.plants import LBT_YAML
from support.robust_config import robust_writer
from support.robustness_maps import evaluate_point

import lbt_synth as lbt
from lbt_synth.cli.main import main

CONFIG = str(LBT_YAML)


def test_robustness(tmp_path, capsys):
    table, figure = tmp_path / "r.csv", tmp_path / "r.png"
    status, text, _ = run(capsys, "robustness", CONFIG, "-o", table, "-o", figure)
    assert status == 0
    assert "error [Hz]" in text
    lines = table.read_text().splitlines()
    assert lines[0].startswith("error_hz,method,strehl,residual_nm")
    assert len(lines) == 31
    assert figure.exists()


@pytest.fixture(scope="module")
def settings():
    return lbt.load_config(LBT_YAML)


@pytest.fixture(scope="module")
def kalman(settings):
    return lbt.kalman(settings.plant)


@pytest.fixture(scope="module")
def robust(settings):
    return lbt.hinf(settings.plant, gamma_ratio=1.2, route="riccati")


@pytest.fixture(scope="module")
def files(tmp_path_factory, kalman, robust):
    folder = tmp_path_factory.mktemp("maps")
    return {
        "kalman": lbt.save_gain(folder / "kalman.fits", kalman),
        "hinf": lbt.save_gain(folder / "hinf.fits", robust),
    }


def test_command_with_gain_files(tmp_path, capsys, files, kalman, settings):
    table, figure = tmp_path / "m.csv", tmp_path / "m.png"
    status, text, error = run(
        capsys,
        "robustness",
        CONFIG,
        *files.values(),
        "--errors-hz",
        -2,
        2,
        5,
        "--sensor-gains",
        0.5,
        1,
        3,
        "--delay-errors",
        0,
        0.1,
        "-o",
        table,
        "-o",
        figure,
    )
    assert (status, error) == (0, "")
    assert "kalman: Strehl ratio at 2.2 um, over frequency errors of -2 to +2 Hz" in text
    assert "hinf: stable sensor gains: 0.5484 to" in text
    assert "with a delay error of +0.1 frames" in text
    assert figure.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert list(rows[0]) == [
        "file",
        "delay_error_frames",
        "sensor_gain",
        "error_hz",
        "strehl",
        "residual_nm",
        "stable",
    ]
    assert len(rows) == 2 * 2 * 3 * 5
    row = rows[1 * 5 + 3]
    assert (row["file"], row["sensor_gain"], row["error_hz"]) == ("kalman", "0.75", "1.0")
    expected = evaluate_point(kalman, settings.truth, settings.imaging, 1.0, 0.75)
    assert (float(row["strehl"]), float(row["residual_nm"])) == pytest.approx(expected, rel=1e-6)
    assert {r["strehl"] for r in rows if r["stable"] == "False"} == {""}


def test_command_without_options_takes_the_configuration(tmp_path, capsys, files):
    data = json.loads(run(capsys, "robustness", CONFIG, files["kalman"], "--json")[1])
    found = data["maps"]["kalman"]
    assert found["errors_hz"][::4] == [x / 2 for x in range(-7, 8)]
    assert (found["sensor_gains"][0], found["sensor_gains"][-1]) == (0.25, 1.3)
    assert np.shape(found["strehl"]) == (1, 43, 57)
    assert found["stable_sensor_gains"][0] == pytest.approx([0.0633, 1.910], rel=1e-3)
    text = LBT_YAML.read_text().replace(
        "  hold: driving",
        "  hold: driving\n  sensor_gains: [0.5, 1.0]\n  delay_errors_frames: [0.1]",
    )
    (tmp_path / "own.yaml").write_text(text)
    data = json.loads(
        run(capsys, "robustness", tmp_path / "own.yaml", files["kalman"], "--json")[1]
    )
    assert data["maps"]["kalman"]["sensor_gains"] == [0.5, 1.0]
    assert data["maps"]["kalman"]["delay_errors_frames"] == [0.1]


def test_sensor_gains_of_the_command_are_real_ones(tmp_path, capsys):
    """A design that assumes a gain of 0.5, in a loop whose gain is 0.5, is right."""
    text = LBT_YAML.read_text().replace("model:  ", "model:\n  sensor_gain: 0.5\n  #")
    (tmp_path / "half.yaml").write_text(text)
    half = lbt.load_config(tmp_path / "half.yaml")
    gain = lbt.save_gain(tmp_path / "half.fits", lbt.kalman(half.plant))
    arguments = ("--errors-hz", 0, 1, 2, "--sensor-gains", 0.5, 0.9, 2, "--json")
    expected = evaluate_point(lbt.load_gain(gain), half.truth, half.imaging, 0.0, 1.0)[0]
    for config in (tmp_path / "half.yaml", CONFIG):  # what the configuration assumes plays no part
        data = json.loads(run(capsys, "robustness", config, gain, *arguments)[1])
        found = data["maps"]["half"]
        assert found["sensor_gains"] == [0.5, 0.9]
        assert found["strehl"][0][0][0] == pytest.approx(expected, rel=1e-6)
        assert found["stable_sensor_gains"][0][0] < 0.5 * 0.2


def test_another_delay_in_the_configuration_gets_a_note(tmp_path, capsys, files):
    text = LBT_YAML.read_text().replace("delay_frames: 2.0", "delay_frames: 2.4")
    (tmp_path / "late.yaml").write_text(text)
    short = ("--errors-hz", 0, 1, 2, "--sensor-gains", 0.1, 1, 9)
    status, text, _ = run(capsys, "robustness", tmp_path / "late.yaml", files["hinf"], *short)
    assert status == 0
    assert "was designed for a delay of 2 frames" in text
    status, text, _ = run(capsys, "robustness", CONFIG, files["hinf"], *short, "--delay-errors", 1)
    assert status == 0
    assert "stable sensor gains with a delay error of +1 frames: none found" in text


def test_command_without_gain_files_is_as_before(tmp_path, capsys, settings):
    text = LBT_YAML.read_text()
    start = text.index("  errors_hz")
    (tmp_path / "few.yaml").write_text(text[:start] + "  errors_hz: [-1, 2]\n")
    status, text, _ = run(
        capsys, "robustness", tmp_path / "few.yaml", "--sensor-gain", 0.8, "--json"
    )
    assert status == 0
    rows = lbt.studies.robustness(
        settings.plant,
        replace(settings.truth, sensor_gain=0.8),
        settings.imaging,
        errors_hz=[-1, 2],
        gamma_ratio=1.2,
    )
    assert json.loads(text)["rows"] == [asdict(row) for row in rows]


BAD = [
    ((CONFIG, "KALMAN", "KALMAN"), "given once"),
    ((CONFIG, "none.fits"), "cannot read none.fits"),
    ((CONFIG, "WALK"), "walk is a filter of a bare estimation problem"),
    ((CONFIG, "AXIS"), "axis must be for the configuration's 2 axes; got a design for 1"),
    ((CONFIG, "FAST"), "fast must run at the configuration's 800 Hz; got a design for 1000 Hz"),
    ((CONFIG, "MIXED"), "mixed must have the configuration's sensor and influence matrices"),
    ((CONFIG, "KALMAN", "--sensor-gain", "0.5"), "--sensor-gain is for redesigning"),
    ((CONFIG, "KALMAN", "--gamma-ratio", "1.1"), "--gamma-ratio is for redesigning"),
    ((CONFIG, "--errors-hz", "-1", "1", "3"), "--errors-hz goes with gain files"),
    ((CONFIG, "--sensor-gains", "0.5", "1", "3"), "--sensor-gains goes with gain files"),
    ((CONFIG, "--delay-errors", "0"), "--delay-errors goes with gain files"),
    ((CONFIG, "KALMAN", "--errors-hz", "1", "-1", "3"), "LOW below HIGH"),
    ((CONFIG, "KALMAN", "--errors-hz", "-1", "1", "2.5"), "COUNT of 2 to 2001; got -1 1 2.5"),
    ((CONFIG, "KALMAN", "--errors-hz", "-1", "1", "1e9"), "COUNT of 2 to 2001"),
    ((CONFIG, "KALMAN", "--errors-hz", "-1", "nan", "3"), "--errors-hz must be finite"),
    ((CONFIG, "KALMAN", "--errors-hz", "-1", "1"), "expected 3 arguments"),
    ((CONFIG, "KALMAN", "--errors-hz", "-30", "1", "3"), "--errors-hz must leave each vibration"),
    ((CONFIG, "KALMAN", "--sensor-gains", "0", "1", "3"), "--sensor-gains must be above 0"),
    ((CONFIG, "KALMAN", "--delay-errors", "-2"), "--delay-errors must be at least -1"),
    ((CONFIG, "KALMAN", "--delay-errors", "0", "0"), "each value once"),
    ((CONFIG, "KALMAN", "-o", "m.xls"), "must end in .csv"),
    ((CONFIG, "KALMAN", "-o", "none/m.png"), "no directory none"),
    (
        ("ZERO", "KALMAN"),
        "robustness.sensor_gains[0]: input should be greater than or equal to 0.001; got 0",
    ),
]


@pytest.fixture(scope="module")
def odd(tmp_path_factory, axis_plant_once, files):
    """Designs and a configuration that do not go together."""
    folder = tmp_path_factory.mktemp("odd")
    walk = lbt.EstimationProblem(A=0.99, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    mixed = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=[[1, 0.1], [0, 1]])
    designs = {
        "walk": lbt.kalman(walk),
        "axis": axis_plant_once,
        "fast": lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000), gain=0.5),
        "mixed": lbt.integrator(mixed, gain=0.5),
    }
    names = {n.upper(): str(lbt.save_gain(folder / f"{n}.npz", d)) for n, d in designs.items()}
    zero = LBT_YAML.read_text().replace("  hold: driving", "  sensor_gains: [0]")
    (folder / "zero.yaml").write_text(zero)
    return names | {"ZERO": str(folder / "zero.yaml"), "KALMAN": str(files["kalman"])}


@pytest.fixture(scope="module")
def axis_plant_once():
    return lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.5)


@pytest.mark.parametrize(("arguments", "text"), BAD)
def test_bad_commands_have_status_2(tmp_path, capsys, monkeypatch, odd, arguments, text):
    monkeypatch.chdir(tmp_path)
    status, out, error = run(capsys, "robustness", *(odd.get(a, a) for a in arguments))
    assert status == 2
    assert out == ""
    assert text in error
    assert not list(tmp_path.iterdir())


@pytest.fixture
def small(tmp_path):
    return robust_writer(tmp_path)


def test_one_file_under_two_spellings_is_refused(small, tmp_path, capsys, monkeypatch):
    config = small()
    monkeypatch.chdir(tmp_path)
    assert main(["design", config, "--method", "robust", "-o", "one.fits"]) == 0
    assert main(["robustness", config, "one.fits", "./one.fits", "-o", "map.png"]) == 2
    assert "must be given once" in capsys.readouterr().err
