"""The commands limits, tradeoff, mirror and robustness, without and with gain files."""

import csv
import json
import re

import numpy as np
import pytest
from support.commands import run
from support.configs import with_errors
from support.limits import RATE, ar
from support.plants import LBT_YAML, ROOT
from support.robust_config import robust_writer
from support.robustness_maps import evaluate_point

import lbt_synth as lbt
from lbt_synth.cli.main import main

CONFIG = str(LBT_YAML)


def test_limits_command(tmp_path, capsys, config):
    gain = lbt.save_gain(tmp_path / "kalman.fits", lbt.kalman(config.plant))
    table, figure = tmp_path / "l.csv", tmp_path / "l.png"
    status, out, _ = run(capsys, "limits", CONFIG, gain, "-o", table, "-o", figure, "--json")
    assert status == 0
    data = json.loads(out)
    assert data["limit_nm"] == pytest.approx(37.7777, abs=1e-4)
    assert data["band_limit_nm"] == pytest.approx(43.8561, abs=1e-4)
    assert data["band_hz"] == [16.5, 23.5]
    rows = {row["design"]: row for row in data["rows"]}
    assert list(rows) == ["integrator", "kalman", "hinf", "kalman (file)"]
    assert rows["kalman"]["residual_nm"] == pytest.approx(rows["kalman (file)"]["residual_nm"])
    assert all(row["above_limit_percent"] > 0 for row in rows.values())
    assert len(table.read_text().splitlines()) == 5
    assert figure.exists()
    status, out, _ = run(capsys, "limits", CONFIG)
    assert status == 0
    assert "least worst residual is 43.8561 nm rms" in " ".join(out.split())
    assert "35.02" in out


def test_limits_command_without_vibrations_and_with_coupled_modes(tmp_path, capsys):
    text = with_errors(LBT_YAML.read_text(), 0)
    line = "    - {kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}\n"
    still = tmp_path / "still.yaml"
    still.write_text(text.replace("  vibrations:\n" + line, ""))
    status, out, _ = run(capsys, "limits", still)
    assert (status, "worst" in out) == (0, False)
    coupled = tmp_path / "coupled.yaml"
    more = (
        "    - {kind: resonance, direction_deg: 30, frequency_hz: 20, rms_mas: 80, damping: 0.01}\n"
        "    - {kind: resonance, axis: tip, frequency_hz: 31, rms_mas: 20, damping: 0.01}\n"
    )
    coupled.write_text(text.replace(line, more))
    assert json.loads(run(capsys, "limits", coupled, "--json")[1])["limit_nm"] is None
    assert "cannot be computed" in run(capsys, "limits", coupled)[1]


def test_show_without_a_limit(tmp_path, capsys):
    """Coupled modes have no limit at a fraction of a frame: a dash, not a failure."""
    lines = [
        lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=50, direction=d)
        for f, d in ((20, (1, 1)), (31, (1, 0)))
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        delay_frames=2.4,
        turbulence=ar(0.99, driving=10),
        vibrations=lines,
        noise_nm=5.0,
    )
    gain = lbt.save_gain(tmp_path / "k.fits", lbt.kalman(plant))
    assert json.loads(run(capsys, "show", gain, "--json")[1])["limit_nm"] is None
    assert run(capsys, "show", gain)[0] == 0


def test_tradeoff(tmp_path, capsys):
    figure, table = tmp_path / "f.png", tmp_path / "f.csv"
    words = ("tradeoff", CONFIG, "--points", 2, "-o", figure, "-o", table)
    status, out, _ = run(capsys, *words)
    assert status == 0
    assert "The least norm of any filter lies between 155.803" in out
    heading = "family,gamma,gamma_ratio,rms,gain_low,gain_high,modulus"
    assert table.read_text().splitlines()[0] == heading
    assert figure.stat().st_size > 10_000
    status, _, error = run(capsys, "tradeoff", CONFIG, "--points", "1")
    assert (status, "--points must be at least 2" in error) == (2, True)


def test_what_the_command_line_says_of_mixed_filters(tmp_path, capsys, monkeypatch):
    target = str(tmp_path / "m.fits")
    config = str(LBT_YAML)
    assert main(["design", config, "--method", "mixed", "--gamma", "1e6", "-o", target]) == 0
    assert "no better choice than the Kalman filter" in capsys.readouterr().out
    assert main(["design", config, "--method", "kalman", "--horizon", "2", "-o", target]) == 0
    assert main(["simulate", config, target]) == 1
    said = capsys.readouterr().err
    assert "the closed loop must be stable; got an unstable one" in said
    assert "note: designed for a delay of 3 frames" in said

    def full(**options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    assert main(["tradeoff", config, "-o", str(tmp_path / "f.png")]) == 2
    assert "takes no new files (No space left on device)" in capsys.readouterr().err


SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"


def run_mirror(capsys, *arguments):
    status = main([*map(str, arguments), "--json"])
    captured = capsys.readouterr()
    return status, json.loads(captured.out), captured.err


def test_the_mirror_settles(tmp_path, capsys):
    gain = tmp_path / "lqg.fits"
    status, data, _ = run_mirror(capsys, "design", SLOW_YAML, "--method", "lqg", "-o", gain)
    assert status == 0
    assert data["rms"] > 0
    assert data["limit_nm"] is None  # of a mirror with dynamics, in the image
    assert data["mirror"]["settling_s"] > 3e-3
    assert run_mirror(capsys, "verify", gain)[0] == 0
    assert run_mirror(capsys, "show", gain, "--matrices")[0] == 0
    figure = tmp_path / "m.png"
    table = tmp_path / "m.csv"
    status, data, _ = run_mirror(capsys, "mirror", SLOW_YAML, "-o", figure, "-o", table)
    assert status == 0
    assert figure.stat().st_size > 10_000
    assert table.read_text().count("\n") == 5
    assert [row["stable"] for row in data["rows"]] == [True, False, True, True]
    status, data, _ = run_mirror(capsys, "simulate", SLOW_YAML, gain, "--frames", 500, "--cases", 1)
    assert status == 0
    assert run_mirror(capsys, "plot", "sigma", gain, "-o", tmp_path / "s.png")[0] == 0


def test_wrong_commands_of_mirror(capsys, gains):
    status, _, err = run(capsys, "simulate", SLOW_YAML, gains["kalman"])
    assert status == 1
    assert "designed for a mirror that settles at once, run with a mirror with dynamics" in err
    for words, text in (
        ((LBT_YAML,), "mirror.local_loop is missing"),
        ((SLOW_YAML, "--tolerance", "2"), "tolerance"),
    ):
        status, _, err = run(capsys, "mirror", *words)
        assert (status, text in err) == (2, True)


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
    assert (
        "At a sensor gain of 1: Strehl ratio at 2.2 um, over frequency errors of -2 to +2" in text
    )
    assert re.search(r"hinf .+ 0\.5484 ", text)
    assert text.startswith("hinf is unstable at ")
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
    assert text.startswith("hinf is unstable at 9 of 9 pairs of a sensor gain and a delay error")


BAD = [
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
    ((CONFIG, "KALMAN", "--errors-hz", "-1", "1", "2.5"), "COUNT of at least 2; got -1 1 2.5"),
    ((CONFIG, "KALMAN", "--errors-hz", "-1", "1"), "expected 3 arguments"),
    ((CONFIG, "KALMAN", "--sensor-gains", "0", "1", "3"), "--sensor-gains must be above 0"),
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


def test_compare(tmp_path, capsys, files, kalman, settings):
    """A line of the command is what the library says of the loop."""
    figure, table = tmp_path / "c.png", tmp_path / "c.csv"
    words = ("compare", CONFIG, *files.values(), "-o", figure, "-o", table)
    data = json.loads(run(capsys, *words, "--json")[1])
    row, other = data["designs"]
    loop = lbt.close_loop(settings.hardware, kalman.controller)
    margins, budget = lbt.loop_margins(loop), lbt.residual_budget(loop, settings.truth)
    assert (row["design"], other["design"]) == ("kalman", "hinf")
    assert row["residual_nm"] == pytest.approx(budget.rms_nm)
    assert row["strehl"] == pytest.approx(lbt.strehl(budget, settings.imaging))
    for name in ("delay_frames", "early_frames", "modulus"):
        assert row[name] == pytest.approx(getattr(margins, name))
    assert (row["gain_less_db"], row["gain_more_db"]) == pytest.approx(margins.gain_errors_db)
    assert (row["n_states"], row["multiplications"]) == (10, 30)
    assert data["limit_nm"] == pytest.approx(37.7777, abs=1e-4)
    assert data["verdict"][0].startswith("kalman leaves 51.0 nm rms in the truth")
    assert data["verdict"][1].startswith("kalman has the largest margin")
    assert table.read_text().count("\n") == 3
    assert figure.stat().st_size > 10_000


def test_compare_begins_with_what_is_unstable(tmp_path, capsys, files):
    loud = tmp_path / "loud.yaml"
    loud.write_text(LBT_YAML.read_text().replace("sensor_gain: 1.0 ", "sensor_gain: 1.8 "))
    status, text, _ = run(capsys, "compare", loud, *files.values())
    assert status == 0
    assert text.startswith("hinf is unstable in the truth. kalman leaves ")
    assert re.search(r"hinf +unstable", text)
