"""The commands compare, limits, tradeoff, mirror, robustness and modal."""

import csv
import importlib
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from support.commands import run
from support.configs import GOOD, minimal_config, with_errors, write_config
from support.plants import LBT_YAML, ROOT
from support.robustness_maps import evaluate_point

import lbt_synth as lbt
from lbt_synth.cli import comparisons
from lbt_synth.studies.limits import limits_at_rate

CONFIG = str(LBT_YAML)
SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"
UNITS = {"nm", "nm rms", "Hz", "%", "frames", "deg", "dB"}


def written(capsys, folder, command, *words, key="rows"):
    """The JSON of a command, whose CSV file has the same rows, and whose figure is drawn."""
    table, figure = folder / "t.csv", folder / "f.png"
    status, text, error = run(capsys, command, *words, "-o", table, "-o", figure, "--json")
    assert (status, error) == (0, "")
    data = json.loads(text)
    assert data["files"] == [str(table), str(figure)]
    for row, record in zip(csv.DictReader(table.read_text().splitlines()), data[key], strict=True):
        assert list(row) == list(record)
        for name, value in record.items():
            if isinstance(value, float):
                assert float(row[name]) == pytest.approx(value, rel=1e-12)
            else:
                assert row[name] == ("" if value is None else str(value))
    assert set(data["units"].values()) <= UNITS
    assert all(name in data or name in data[key][0] for name in data["units"])
    assert figure.read_bytes().startswith(b"\x89PNG")
    return data


def test_limits_command(tmp_path, capsys, gains):
    data = written(capsys, tmp_path, "limits", CONFIG, gains["kalman"])
    assert data["limit_nm"] == pytest.approx(37.7777, abs=1e-4)
    assert data["band_limit_nm"] == pytest.approx(43.8561, abs=1e-4)
    assert data["band_hz"] == [16.5, 23.5]
    assert "least worst residual is 43.8561 nm rms" in data["verdict"][-1]
    rows = {row["design"]: row for row in data["rows"]}
    assert list(rows) == ["integrator", "kalman", "hinf", "kalman (file)"]
    assert rows["kalman"]["residual_nm"] == pytest.approx(rows["kalman (file)"]["residual_nm"])
    assert rows["kalman"]["above_limit_percent"] == pytest.approx(35.02, abs=0.01)


def test_limits_command_without_vibrations_and_with_coupled_modes(tmp_path, capsys):
    text = with_errors(LBT_YAML.read_text(), 0)
    line = "    - {kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}\n"
    still, coupled = tmp_path / "still.yaml", tmp_path / "coupled.yaml"
    still.write_text(text.replace("  vibrations:\n" + line, ""))
    status, out, _ = run(capsys, "limits", still)
    assert (status, "worst" in out) == (0, False)
    more = (
        "    - {kind: resonance, direction_deg: 30, frequency_hz: 20, rms_mas: 80, damping: 0.01}\n"
        "    - {kind: resonance, axis: tip, frequency_hz: 31, rms_mas: 20, damping: 0.01}\n"
    )
    coupled.write_text(text.replace(line, more))
    assert "limit of this loop cannot be computed" in run(capsys, "limits", coupled)[1]


def test_limits_over_the_frame_rate(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(comparisons, "_RATES", 15)
    words = ("limits", CONFIG, "--frame-rates", 800, 1600)
    status, out, _ = run(capsys, *words)
    assert status == 0
    assert out.startswith("The best frame rate is 1600 Hz, an end of the range, for the integrator")
    assert "the photons per second stay; the read noise of a frame stays; the delay stays 2" in out
    assert 10 < len(re.findall(r"^ +\d+ +\d+\.\d ", out, re.MULTILINE)) <= 12
    data = written(capsys, tmp_path, *words)
    rows = data["rows"]
    assert [row["frame_rate_hz"] for row in rows] == pytest.approx(np.geomspace(800, 1600, 15))
    assert rows[0] == pytest.approx(limits_at_rate(lbt.load_config(CONFIG), 800.0).values)
    best = min(rows, key=lambda row: row["kalman_nm"])
    assert data["best_kalman_hz"] == best["frame_rate_hz"]
    assert f" {best['frame_rate_hz']:.0f} Hz for the Kalman filter (" in data["verdict"][0]


def test_what_is_unstable_or_has_no_limit_has_no_best_frame_rate(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(comparisons, "_RATES", 2)
    content = minimal_config(truth={"sensor_gain": 2.2, "vibrations": "model"})
    content |= {"telescope": GOOD["telescope"], "atmosphere": GOOD["atmosphere"]}
    content["model"]["turbulence"] = {"kind": "ar1"}
    turned = {"direction_deg": 30.0, "frequency_hz": 31.0, "damping": 0.01, "rms_nm": 200.0}
    content["model"]["vibrations"].append(turned)
    words = ("limits", write_config(tmp_path, content), "--frame-rates", 700, 900)
    data = json.loads(run(capsys, *words, "--json")[1])
    assert data["rows"][0]["kalman_nm"] is data["rows"][0]["limit_nm"] is None
    (verdict,) = data["verdict"]
    assert re.match(r"The best frame rate is \d+ Hz, an end of the range, for the integr", verdict)
    assert "Kalman" not in verdict
    assert "limit" not in verdict
    out = " ".join(run(capsys, *words)[1].split())
    assert "the noise is that of photons, its variance in proportion to the rate" in out


def test_frame_rates_are_those_of_the_mirrors_local_loop(capsys, monkeypatch):
    monkeypatch.setattr(comparisons, "_RATES", 3)
    out = run(capsys, "limits", SLOW_YAML, "--frame-rates", 700, 910, "--json")[1]
    rates = np.array([row["frame_rate_hz"] for row in json.loads(out)["rows"]])
    samples = lbt.load_config(SLOW_YAML).hardware.mirror.sampling_hz / rates
    assert samples == pytest.approx(np.round(samples))
    assert rates == pytest.approx([700, 798, 910], rel=0.01)


def test_frame_rates_that_cannot_be_compared_are_refused(tmp_path, capsys, gains):
    fixed = write_config(tmp_path, minimal_config())
    for words, message in (
        ((CONFIG, "--frame-rates", 900, 300), "--frame-rates must be LOW below HIGH; got 900 300"),
        ((CONFIG, "--frame-rates", 0, 300), "--frame-rates must be above 0; got 0"),
        ((CONFIG, "--frame-rates", 30, 300), "at 30 Hz: .*below the Nyquist frequency 15 Hz"),
        ((CONFIG, gains["kalman"], "--frame-rates", 300, 900), "leave the gain files out"),
        (
            (fixed, "--frame-rates", 300, 900),
            "kind ar is known at 800 Hz alone. Give an atmosphere",
        ),
    ):
        status, out, error = run(capsys, "limits", *words)
        assert (status, out) == (2, "")
        assert re.search(message, error)


def test_tradeoff(tmp_path, capsys):
    data = written(capsys, tmp_path, "tradeoff", CONFIG, "--points", 2, key="points")
    columns = "family gamma gamma_ratio rms gain_low gain_high modulus"
    assert list(data["points"][0]) == columns.split()
    assert data["gamma_infeasible"] < data["gamma_least"] == pytest.approx(155.803, abs=1e-3)


def test_command_with_gain_files(tmp_path, capsys, gains, config):
    table, figure = tmp_path / "m.csv", tmp_path / "m.png"
    points = ("--errors-hz", -2, 2, 5, "--sensor-gains", 0.5, 1, 3, "--delay-errors", 0, 0.1)
    words = ("robustness", CONFIG, gains["kalman"], gains["hinf"], *points)
    status, text, error = run(capsys, *words, "-o", table, "-o", figure)
    assert (status, error) == (0, "")
    assert "At a sensor gain of 1: Strehl ratio at 2.2 um, over frequency errors of -2 to" in text
    assert text.startswith("hinf is unstable at ")
    assert figure.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    columns = "file delay_error_frames sensor_gain error_hz strehl residual_nm stable"
    assert list(rows[0]) == columns.split()
    assert len(rows) == 2 * 2 * 3 * 5
    row = rows[1 * 5 + 3]
    assert (row["file"], row["sensor_gain"], row["error_hz"]) == ("kalman", "0.75", "1.0")
    expected = evaluate_point(lbt.kalman(config.plant), config.truth, config.imaging, 1.0, 0.75)
    assert (float(row["strehl"]), float(row["residual_nm"])) == pytest.approx(expected, rel=1e-6)
    assert {r["strehl"] for r in rows if r["stable"] == "False"} == {""}


def test_sensor_gains_of_the_command_are_real_ones(tmp_path, capsys):
    """A design that assumes a gain of 0.5, in a loop whose gain is 0.5, is right."""
    text = LBT_YAML.read_text().replace("model:  ", "model:\n  sensor_gain: 0.5\n  #")
    (tmp_path / "half.yaml").write_text(text)
    half = lbt.load_config(tmp_path / "half.yaml")
    gain = lbt.save_gain(tmp_path / "half.fits", lbt.kalman(half.plant))
    arguments = ("--errors-hz", 0, 1, 2, "--sensor-gains", 0.5, 0.9, 2, "--json")
    expected = evaluate_point(lbt.load_gain(gain), half.truth, half.imaging, 0.0, 1.0)[0]
    for config in (tmp_path / "half.yaml", CONFIG):  # what the configuration assumes plays no part
        data = json.loads(run(capsys, "robustness", config, gain, *arguments)[1])["maps"]["half"]
        assert data["sensor_gains"] == [0.5, 0.9]
        assert data["strehl"][0][0][0] == pytest.approx(expected, rel=1e-6)


def test_a_map_is_of_the_loop_of_the_configuration(tmp_path, capsys, gains):
    """Its values are those of the configuration, and so is the delay that errors count from."""
    text = LBT_YAML.read_text().replace("delay_frames: 2.0", "delay_frames: 2.4")
    values = "  hold: driving\n  sensor_gains: [0.5, 1.0]\n  delay_errors_frames: [-0.3]"
    (tmp_path / "late.yaml").write_text(text.replace("  hold: driving", values))
    words = ("robustness", tmp_path / "late.yaml", gains["kalman"])
    data = json.loads(run(capsys, *words, "--json")[1])["maps"]["kalman"]
    assert data["errors_hz"][::4] == [x / 2 for x in range(-7, 8)]
    assert (data["sensor_gains"], data["delay_errors_frames"]) == ([0.5, 1.0], [-0.3])
    few = ("--errors-hz", 0, 1, 2, "--sensor-gains", 0.1, 1, 9)
    text = " ".join(run(capsys, *words, *few, "--delay-errors", 1)[1].split())
    assert text.startswith("kalman is unstable at 9 of 9 pairs of a sensor gain and a delay error")
    assert "note: designed for a delay of 2 frames, run with 2.4 (kalman)." in text


def test_compare(tmp_path, capsys, gains, config):
    """A line of the command is what the library says of the loop."""
    words = ("compare", CONFIG, gains["kalman"], gains["hinf"])
    data = written(capsys, tmp_path, *words, key="designs")
    row, other = data["designs"]
    loop = lbt.close_loop(config.hardware, lbt.load_gain(gains["kalman"]))
    margins, budget = lbt.loop_margins(loop), lbt.residual_budget(loop, config.truth)
    assert (row["design"], other["design"]) == ("kalman", "hinf")
    assert row["residual_nm"] == pytest.approx(budget.rms_nm)
    assert row["strehl"] == pytest.approx(lbt.strehl(budget, config.imaging))
    for name in ("delay_frames", "early_frames", "modulus"):
        assert row[name] == pytest.approx(getattr(margins, name))
    assert (row["gain_less_db"], row["gain_more_db"]) == pytest.approx(margins.gain_errors_db)
    assert (row["n_states"], row["multiplications"]) == (10, 30)
    assert data["limit_nm"] == pytest.approx(37.7777, abs=1e-4)
    assert data["verdict"][0].startswith("kalman leaves 51.0 nm rms in the truth")
    assert data["verdict"][1].startswith("kalman has the largest margin")


def test_compare_begins_with_what_is_unstable(tmp_path, capsys, gains):
    loud = tmp_path / "loud.yaml"
    loud.write_text(LBT_YAML.read_text().replace("sensor_gain: 1.0 ", "sensor_gain: 1.8 "))
    status, text, _ = run(capsys, "compare", loud, gains["kalman"], gains["hinf"])
    assert status == 0
    assert text.startswith("hinf is unstable in the truth. kalman leaves ")
    assert re.search(r"hinf +unstable", text)


def test_the_mirror_settles(tmp_path, capsys):
    few = tmp_path / "few.yaml"
    few.write_text(with_errors(SLOW_YAML.read_text(), 0))
    data = written(capsys, tmp_path, "mirror", few)
    assert [row["stable"] for row in data["rows"]] == [True, False, True, True]
    assert data["settling_s"] > 3e-3


def test_modal_knows_the_local_loop(tmp_path, capsys, monkeypatch):
    """Gains and filters of a slow mirror are those of loops with that mirror."""
    calls = []
    gains = lambda _, **loop: calls.append(loop) or some  # noqa: E731
    module = importlib.import_module("lbt_synth.studies.robustness")
    monkeypatch.setattr(module, "modal_gains", gains)
    config, line = lbt.load_config(SLOW_YAML), lbt.load_config(SLOW_YAML).plant.vibrations[0]
    assert config.hardware.mirror is not None
    air = lbt.models.modal_turbulence(config.atmosphere, modes=2, frame_rate_hz=800)
    noise = lbt.models.pyramid_modal_noise_nm(config.noise_nm, modes=2, modulation_lambda_over_d=4)
    known = {"hardware": config.hardware, "noise_nm": noise, "vibrations": {0: line, 1: line}}
    filters = lbt.design.modal.modal_filters(air, **known)
    some = SimpleNamespace(gains=np.array([0.2, 0.4]), rms_nm=np.array([3.0, 4.0]))
    data = written(capsys, tmp_path, "modal", SLOW_YAML, "--modes", 2)
    ((loop,), left) = calls, data["residual_nm"]
    assert loop["hardware"].mirror == config.hardware.mirror
    assert loop["noise_nm"] == pytest.approx(noise)
    assert data["rows"][0]["gain"] == pytest.approx(0.3)
    assert left["integrators, optimised gains"] == pytest.approx(5)
    assert left["Kalman filters"] == pytest.approx(np.linalg.norm(filters.rms_nm))


def test_what_has_no_comparison_is_refused(tmp_path, capsys, gains):
    text = LBT_YAML.read_text()
    start, end = text.index("  pyramid:"), text.index("mirror:")
    plain = text[:start] + "  noise_nm: 12.0\n\n" + text[end:]
    without = plain.replace("  modes: 672 ", "  # modes: 672 ").replace("mirror:\n", "mirror: {}\n")
    files = {
        "PLAIN": plain,
        "UNEVEN": plain.replace("noise_nm: 12.0", "noise_nm: [12.0, 9.0]"),
        "WITHOUT": without,
    }
    for name, content in files.items():
        (tmp_path / f"{name}.yaml").write_text(content)
    data = json.loads(run(capsys, "modal", tmp_path / "PLAIN.yaml", "--modes", 2, "--json")[1])
    assert {row["noise_nm"] for row in data["rows"]} == {12.0}
    places = {name: tmp_path / f"{name}.yaml" for name in files}
    places |= {"CONFIG": CONFIG, "GAIN": gains["kalman"]}
    for words, said in (
        ("modal UNEVEN", "sensor.noise_nm must be one number for hundreds of modes"),
        ("modal WITHOUT", "the key mirror.modes is missing"),
        ("mirror CONFIG", "mirror.local_loop is missing"),
        ("tradeoff CONFIG --points 1", "--points must be at least 2"),
        ("robustness CONFIG GAIN --errors-hz -1 1 2.5", "COUNT of at least 2; got -1 1 2.5"),
        ("robustness CONFIG GAIN --sensor-gains 0 1 3", "--sensor-gains must be above 0"),
        ("robustness CONFIG GAIN GAIN", "each gain file must have a name"),
    ):
        status, out, error = run(capsys, *(places.get(word, word) for word in words.split()))
        assert (status, out, said in error) == (2, "", True), error
