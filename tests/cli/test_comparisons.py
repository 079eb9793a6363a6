"""The commands compare, limits, tradeoff, mirror, robustness and modal."""

import csv
import re

import numpy as np
import pytest
from support.commands import run_done, run_json
from support.configs import GOOD, minimal_config, with_errors, write_config
from support.plants import LBT_YAML, ROOT
from support.robustness_maps import evaluate_point

import lbt_synth as lbt
from lbt_synth.cli import comparisons
from lbt_synth.studies.limits import limits_at_rate

LBT = LBT_YAML.read_text()
SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"
UNITS = {"nm", "nm rms", "Hz", "%", "frames", "deg", "dB"}


def written(capsys, folder, command, *words, key="rows"):
    """The JSON of a command, whose CSV file has the same rows, and whose figure is drawn."""
    table, figure = folder / "t.csv", folder / "f.png"
    data = run_json(capsys, command, *words, "-o", table, "-o", figure)
    assert data["files"] == [str(table), str(figure)]
    for row, record in zip(csv.DictReader(table.read_text().splitlines()), data[key], strict=True):
        numbers = {name: value for name, value in record.items() if isinstance(value, float)}
        texts = {name: "" if value is None else str(value) for name, value in record.items()}
        assert {name: float(row[name]) for name in numbers} == pytest.approx(numbers, rel=1e-12)
        assert list(row.items()) == [*(texts | {name: row[name] for name in numbers}).items()]
    assert set(data["units"].values()) <= UNITS
    assert all(name in data or name in data[key][0] for name in data["units"])
    assert figure.read_bytes().startswith(b"\x89PNG")
    return data


def test_limits_command(tmp_path, capsys, gains):
    data = written(capsys, tmp_path, "limits", LBT_YAML, gains["kalman"])
    limits = {"limit_nm": 37.7777, "band_limit_nm": 43.8561}
    assert {name: data[name] for name in limits} == pytest.approx(limits, abs=1e-4)
    assert data["band_hz"] == [16.5, 23.5]
    assert "no controller has a worst residual below 43.8561 nm rms" in data["verdict"][-1]
    rows = {row["design"]: row for row in data["rows"]}
    assert list(rows) == ["integrator", "kalman", "hinf", "kalman (file)"]
    assert rows["kalman"]["residual_nm"] == pytest.approx(rows["kalman (file)"]["residual_nm"])
    assert rows["kalman"]["above_limit_percent"] == pytest.approx(35.02, abs=0.01)


def test_limits_over_the_frame_rate(tmp_path, capsys, monkeypatch, config):
    monkeypatch.setattr(comparisons, "_RATES", 15)
    words = ("limits", LBT_YAML, "--frame-rates", 800, 1600)
    out = run_done(capsys, *words)
    assert out.startswith("The best frame rate is 1600 Hz, an end of the range, for the integrator")
    assert "the photons per second stay; the read noise of a frame stays; the delay stays 2" in out
    assert 10 < len(re.findall(r"^ +\d+ +\d+\.\d ", out, re.MULTILINE)) <= 12
    monkeypatch.setattr(comparisons, "_RATES", 3)
    data = written(capsys, tmp_path, *words)
    rows = data["rows"]
    assert [row["frame_rate_hz"] for row in rows] == pytest.approx(np.geomspace(800, 1600, 3))
    assert rows[0] == pytest.approx(limits_at_rate(config, 800.0).values)
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
    data = run_json(capsys, *words)
    assert data["rows"][0]["kalman_nm"] is data["rows"][0]["limit_nm"] is None
    (verdict,) = data["verdict"]
    assert re.match(r"The best frame rate is \d+ Hz, an end of the range, for the integr", verdict)
    assert not re.search("Kalman|limit", verdict)
    out = " ".join(run_done(capsys, *words).split())
    assert "the noise is that of photons, its variance in proportion to the rate" in out
    assert "limit of this loop cannot be computed" in run_done(capsys, *words[:2])
    still = write_config(tmp_path, {k: v for k, v in GOOD.items() if k != "truth"})
    assert "worst" not in run_done(capsys, "limits", still)


def test_frame_rates_are_those_of_the_mirrors_local_loop(capsys, monkeypatch):
    monkeypatch.setattr(comparisons, "_RATES", 3)
    rows = run_json(capsys, "limits", SLOW_YAML, "--frame-rates", 700, 910)["rows"]
    rates = np.array([row["frame_rate_hz"] for row in rows])
    samples = lbt.load_config(SLOW_YAML).hardware.mirror.sampling_hz / rates
    assert samples == pytest.approx(np.round(samples))
    assert rates == pytest.approx([700, 798, 910], rel=0.01)


def test_tradeoff_and_mirror(tmp_path, capsys):
    data = written(capsys, tmp_path, "tradeoff", LBT_YAML, "--points", 2, key="points")
    columns = "family gamma gamma_ratio rms gain_low gain_high modulus"
    assert list(data["points"][0]) == columns.split()
    assert data["gamma_infeasible"] < data["gamma_least"] == pytest.approx(155.803, abs=1e-3)
    few = write_config(tmp_path, with_errors(SLOW_YAML.read_text(), 0))
    data = written(capsys, tmp_path, "mirror", few)
    assert [row["stable"] for row in data["rows"]] == [True, False, True, True]
    assert data["settling_s"] > 3e-3


def test_command_with_gain_files(tmp_path, capsys, gains, config):
    table, figure = tmp_path / "m.csv", tmp_path / "m.png"
    points = ("--errors-hz", -2, 2, 5, "--sensor-gains", 0.5, 1, 3, "--delay-errors", 0, 0.1)
    words = ("robustness", LBT_YAML, gains["kalman"], gains["hinf"], *points)
    text = run_done(capsys, *words, "-o", table, "-o", figure)
    assert "At a sensor gain of 1: Strehl ratio at 2.2 um, over frequency errors of -2 to" in text
    assert text.startswith("hinf is unstable at ")
    assert figure.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    columns = "file delay_error_frames sensor_gain error_hz strehl residual_nm stable"
    assert (" ".join(rows[0]), len(rows)) == (columns, 2 * 2 * 3 * 5)
    row = rows[1 * 5 + 3]
    assert (row["file"], row["sensor_gain"], row["error_hz"]) == ("kalman", "0.75", "1.0")
    expected = evaluate_point(lbt.kalman(config.plant), config.truth, config.imaging, 1.0, 0.75)
    assert (float(row["strehl"]), float(row["residual_nm"])) == pytest.approx(expected, rel=1e-6)
    assert {r["strehl"] for r in rows if r["stable"] == "False"} == {""}


def test_a_map_is_of_the_loop_of_the_configuration(tmp_path, capsys):
    """Its values are those of the file, with real gains, whatever gain the design assumes."""
    assumed = LBT.replace("model:  ", "model:\n  sensor_gain: 0.5\n  #")
    half = lbt.load_config(write_config(tmp_path, assumed))
    gain = lbt.save_gain(tmp_path / "half.fits", half.design("kalman"))
    values = "  sensor_gains: [0.6, 1.0]\n  delay_errors_frames: [-0.3]\n  hold: "
    text = LBT.replace("delay_frames: 2.0", "delay_frames: 2.4").replace("  hold: ", values)
    words = ("robustness", write_config(tmp_path, text), gain)
    data = run_json(capsys, *words)["maps"]["half"]
    assert data["errors_hz"][::4] == [x / 2 for x in range(-7, 8)]
    assert (data["sensor_gains"], data["delay_errors_frames"]) == ([0.6, 1.0], [-0.3])
    design = lbt.load_gain(gain)
    expected, _ = evaluate_point(design, half.truth, half.imaging, -3.5, 0.6 / 0.5, 0.1)
    assert data["strehl"][0][0][0] == pytest.approx(expected, rel=1e-6)
    few = ("--errors-hz", 0, 1, 2, "--sensor-gains", 0.1, 1, 9, "--delay-errors", 1)
    said = " ".join(run_done(capsys, *words, *few).split())
    assert said.startswith("half is unstable at 8 of 9 pairs of a sensor gain and a delay error")
    assert "note: designed for a delay of 2 frames, run with 2.4 (half)." in said
    beyond = write_config(tmp_path, LBT.replace("  sensor_gain: 1.0 ", "  sensor_gain: 2.0 "))
    assert "At a sensor gain of 2: Strehl" in run_done(capsys, "robustness", beyond, gain)


def test_compare(tmp_path, capsys, gains, config):
    """A line of the command is what the library says of the loop; it begins with instability."""
    words = (gains["kalman"], gains["hinf"])
    data = written(capsys, tmp_path, "compare", LBT_YAML, *words, key="designs")
    row, other = data["designs"]
    loop = lbt.close_loop(config.hardware, lbt.load_gain(gains["kalman"]))
    margins, budget = lbt.loop_margins(loop), lbt.residual_budget(loop, config.truth)
    assert (row["design"], other["design"]) == ("kalman", "hinf")
    names = ("delay_frames", "early_frames", "modulus")
    expected = {name: getattr(margins, name) for name in names}
    expected |= zip(("gain_less_db", "gain_more_db"), margins.gain_errors_db, strict=True)
    expected |= {"residual_nm": budget.rms_nm, "strehl": lbt.strehl(budget, config.imaging)}
    expected |= {"n_states": 10, "multiplications": 30}
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    assert data["limit_nm"] == pytest.approx(37.7777, abs=1e-4)
    assert data["verdict"][0].startswith("kalman leaves 51.0 nm rms in the truth")
    assert data["verdict"][1].startswith("kalman has the largest margin")
    loud = write_config(tmp_path, LBT.replace("sensor_gain: 1.0 ", "sensor_gain: 1.8 "))
    text = run_done(capsys, "compare", loud, *words)
    assert text.startswith("hinf is unstable in the truth. kalman leaves ")
    assert re.search(r"hinf +unstable", text)


@pytest.mark.parametrize("pyramid", [True, False])
def test_modal_knows_the_noise_and_the_local_loop(tmp_path, capsys, pyramid):
    """Gains and filters of a slow mirror are those of loops with that mirror and that noise."""
    plain = re.sub(r"(?s)  pyramid:.*?(?=mirror:)", "  noise_nm: 12.0\n\n", LBT_YAML.read_text())
    file = SLOW_YAML if pyramid else write_config(tmp_path, plain)
    config = lbt.load_config(file)
    line, noise = config.plant.vibrations[0], np.full(2, 12.0)
    assert (config.hardware.mirror is not None) is pyramid
    if pyramid:
        modulation = {"modes": 2, "modulation_lambda_over_d": 4}
        noise = lbt.models.pyramid_modal_noise_nm(config.noise_nm, **modulation)
    known = {"hardware": config.hardware, "noise_nm": noise, "vibrations": {0: line, 1: line}}
    air = lbt.models.modal_turbulence(config.atmosphere, modes=2, frame_rate_hz=800)
    gains, filters = (
        design(air, **known)
        for design in (lbt.design.modal.modal_gains, lbt.design.modal.modal_filters)
    )
    data = written(capsys, tmp_path, "modal", file, "--modes", 2)
    assert data["rows"][0]["gain"] == pytest.approx(np.mean(gains.gains))
    expected = {"integrators, optimised gains": gains, "Kalman filters": filters}
    assert data["residual_nm"] == pytest.approx(
        {name: np.linalg.norm(design.rms_nm) for name, design in expected.items()}
    )
