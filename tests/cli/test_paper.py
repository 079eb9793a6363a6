"""The commands paper and end-to-end: tables of the paper, and loops with a pyramid."""

import csv
import importlib.metadata
import re
from dataclasses import replace
from functools import partial
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from support.commands import refuse_commands, run, run_done, run_json
from support.end_to_end import CONFIG, load_setup, make_run
from support.refusals import refused
from support.small_telescope import needs_specula, small_config

import lbt_synth as lbt
from lbt_synth.cli import paper
from lbt_synth.errors import MissingExtraError, ProblemError
from lbt_synth.interop.specula.simulation import mix_controller
from lbt_synth.report.figures.studies import robustness_figure


def test_the_paper_is_written_and_its_points_lie_on_our_curves(tmp_path, capsys, monkeypatch):
    drawn, folder = [], tmp_path / "paper"
    draw = lambda *rows: drawn.append(robustness_figure(*rows)) or drawn[-1]  # noqa: E731
    monkeypatch.setattr(paper.figures, "robustness_figure", draw)
    text = run_done(capsys, "paper", "-o", folder, "--unit", "mas", "--verbose")
    assert "Table III: Strehl ratio" in text
    assert re.search(r"turbulence pole, rms +0\.98860, 59\.38 mas ", text)
    assert re.search(r"80 mas as the rms of a sinusoid +80\.00 mas ", text)
    assert " nm" not in text
    assert "797.0 nm" in (folder / "parameters.csv").read_text()  # CSV stays in nm
    tables = "table_ii.csv table_iii.csv parameters.csv paper_kalman.fits paper_hinf.fits"
    figures = "robustness.png robustness.pdf sigma.png sigma.pdf"
    assert {path.name for path in folder.iterdir()} == {*tables.split(), *figures.split()}
    rows = list(csv.DictReader((folder / "table_iii.csv").read_text().splitlines()))
    assert (len(rows), float(rows[0]["paper_strehl_percent"])) == (30, 22.4)
    assert lbt.load_gain(folder / "paper_hinf.fits").recertify().passed
    lines = {line.get_label(): line.get_xydata() for line in drawn[0].axes[0].get_lines()}
    assert len(lines) == 4
    for name in ("Kalman", "H∞"):
        ours, theirs = lines[name], sorted(map(tuple, lines[f"{name}, paper"]))
        assert ours[:, 0].tolist() == [error for error, _ in theirs]
        assert max(abs(ours[:, 1] - [strehl for _, strehl in theirs])) < 1.5  # points of percent


PATH = lbt.LoopHardware(frame_rate_hz=800)


def integrator_file(folder, hardware=PATH):
    return lbt.save_gain(folder / "i.fits", lbt.integrator(hardware, gain=0.1))


@pytest.mark.parametrize("found", [None, "1.0.3", "1.2.0"])
def test_without_the_extra_the_command_says_how_to_get_it(monkeypatch, tmp_path, capsys, found):
    real = importlib.metadata.version

    def version(name):
        if name == "specula" and found is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return found if name == "specula" else real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    places = {"GAIN": integrator_file(tmp_path), "OUT": tmp_path / "run"}
    advice = 'pip install "lbt-synth[e2e]"'
    rows = [(f"end-to-end {CONFIG} {rest} -o OUT", advice) for rest in ("GAIN", "--tables II")]
    refuse_commands(capsys, rows, **places)
    call = partial(lbt.interop.run_end_to_end, lbt.load_config(CONFIG).end_to_end, None)
    assert refused(call, MissingExtraError, None).extra == "e2e"


def test_the_telemetry_of_a_run_has_its_mirror(monkeypatch, tmp_path):
    setup = load_setup()
    bands = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 150}
    shell = lbt.models.PositionLoop.from_bandwidth(**bands)
    slow = replace(setup.hardware, mirror=shell)
    loop_run = make_run(replace(setup, modes=3, hardware=slow), frames=20)
    gain = integrator_file(tmp_path, slow)
    monkeypatch.setattr(paper, "specula_version", lambda: "1.1")
    seen = paper._telemetry(loop_run, lbt.load_gain(gain), str(gain))
    seen = lbt.files.load_telemetry(lbt.files.save_telemetry(tmp_path / "t.fits", seen))
    assert np.array_equal(seen.hardware.mirror_taps, slow.mirror_taps)
    assert "with the mirror taps c" in seen.convention


def test_a_loop_that_ran_away_ends_in_words(monkeypatch, tmp_path, capsys):
    """A pyramid out of its range returns the same slopes whatever the tilt."""
    loop_run = make_run(replace(load_setup(), modes=3), frames=100)
    lost = replace(loop_run, residual_nm=1e9 * (1 + loop_run.residual_nm))
    monkeypatch.setattr(paper, "specula_version", lambda: "1.1")
    monkeypatch.setattr(paper, "calibrate", lambda *_, **__: None)
    monkeypatch.setattr(paper.simulation, "run_end_to_end", lambda *_, **__: lost)
    out = tmp_path / "run"
    words = ("end-to-end", CONFIG, integrator_file(tmp_path), "-o", out)
    status, text, error = run(capsys, *words)
    assert (status, text, list(out.iterdir())) == (1, "", [])
    assert "the loop ran away. Try more than 60 pixels" in error


def test_tip_and_tilt_are_shown_as_angles_and_other_modes_are_not(monkeypatch, tmp_path, capsys):
    loop_run, out = make_run(replace(load_setup(), modes=3), frames=400), tmp_path / "run"
    calibration = SimpleNamespace(reconstructor=np.eye(2))
    monkeypatch.setattr(paper, "specula_version", lambda: "1.1")
    monkeypatch.setattr(paper, "calibrate", lambda *_, **__: calibration)
    monkeypatch.setattr(paper.simulation, "run_end_to_end", lambda *_, **__: loop_run)
    words = ("end-to-end", CONFIG, integrator_file(tmp_path), "-o", out, "--unit", "mas")
    text = run_done(capsys, *words, "--verbose")
    tip, tilt = loop_run.rms_nm[:2] / lbt.models.nm_per_mas(8.22)
    assert f"{tip:.2f} mas rms of tip and {tilt:.2f} mas of tilt left" in " ".join(text.split())
    assert re.search(rf"other modes +{loop_run.rms_nm[2]:.1f} +nm rms", text)
    assert lbt.files.load_telemetry(out / "telemetry.fits").shown_unit == "mas"


@needs_specula
def test_the_command_writes_telemetry_that_is_the_run(tmp_path, capsys):
    config, out = small_config(tmp_path), tmp_path / "run"
    gain = lbt.save_gain(tmp_path / "k.fits", lbt.kalman(lbt.load_config(config).plant))
    words = ("end-to-end", config, gain, "-o", out)
    data = run_json(capsys, *words)
    assert sorted(p.name for p in out.iterdir()) == ["run.png", "telemetry.fits"]
    telemetry = lbt.files.load_telemetry(out / "telemetry.fits")
    assert telemetry.metadata["strehl"] == data["strehl"]
    assert telemetry.commands.shape == (40, 20)
    assert np.std(telemetry.residual_nm[:, 0]) <= data["tip_rms_nm"] * (1 + 1e-12)
    # y(k+1) is the gain times the residual of frame k, plus noise
    y, phase = telemetry.measurements[1:, :2], telemetry.residual_nm[:-1, :2]
    assert np.sum(y * phase) / np.sum(phase**2) == pytest.approx(telemetry.sensor_gain)
    assert "Strehl ratio at 2.2 um" in run_done(capsys, *words)


SENSORS = """
sensors:
  truth: {rate_hz: 100, delay_frames: 2, noise_nm: 10}
  mirror:
    {kind: accelerometer, rate_hz: 800, delay_frames: 1, channels: [m1], noise_m_s2: 2.0e-3}
"""


@needs_specula
def test_a_design_of_several_sensors_runs_without_those_that_are_not_simulated(tmp_path, capsys):
    file = small_config(tmp_path)
    text = file.read_text()
    for old in ("axis: both, frequency_hz: 20.0", "kind: sinusoid, axis: tip"):
        assert old in text
        text = text.replace(old, f"accelerometers: {{m1: {{motion_nm_per_nm: 2}}}}, {old}")
    file.write_text(text + SENSORS)
    gain = lbt.save_gain(tmp_path / "sensors.fits", lbt.load_config(file).design("kalman"))
    text = run_done(capsys, "end-to-end", file, gain, "-o", tmp_path / "run")
    words = "the fall-back filter of the gain file runs, without truth."
    assert words in " ".join(text.split())
    alone = lbt.load_config(small_config(tmp_path)).end_to_end
    mix = partial(mix_controller, alone, lbt.load_gain(gain))
    refused(mix, ProblemError, r"moves a channel of the design \(m1\)")


@needs_specula
def test_a_table_goes_on_where_it_was(tmp_path, capsys):
    out = tmp_path / "table"
    words = f"end-to-end {small_config(tmp_path)} -o {out} --seeds 1 --tables II --jobs 2".split()
    run_done(capsys, *words)
    lost, *kept = out.glob("cases/*.npz")
    lost.unlink()
    before = [path.stat() for path in kept]
    data = run_json(capsys, *words)
    assert (data["runs"], lost.exists(), [path.stat() for path in kept]) == (6, True, before)
    rows, methods = ("no vibration", "vibration"), ("classical", "kalman", "hinf")
    assert {(e["row"], e["method"]) for e in data["table_ii"]} == {*product(rows, methods)}
    assert len((out / "table_ii.csv").read_text().splitlines()) == 7
