"""The commands paper and end-to-end: tables of the paper, and loops with a pyramid."""

import contextlib
import csv
import importlib.metadata
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from support.end_to_end import CONFIG, load_setup, make_run
from support.small_telescope import needs_specula, small_config

import lbt_synth as lbt
from lbt_synth.cli import paper
from lbt_synth.cli.main import main
from lbt_synth.errors import MissingExtraError, ProblemError
from lbt_synth.interop.specula.simulation import mix_controller
from lbt_synth.report.figures.studies import robustness_figure


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of the paper, what the command says in mas, and its figure of robustness."""
    drawn, said, folder = [], io.StringIO(), tmp_path_factory.mktemp("paper")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        draw = lambda *rows: drawn.append(robustness_figure(*rows)) or drawn[-1]  # noqa: E731
        patch.setattr(paper.figures, "robustness_figure", draw)
        assert main(["paper", "-o", str(folder), "--unit", "mas", "--verbose"]) == 0
    return folder, said.getvalue(), drawn[0]


def test_written_files(written):
    folder, text, _ = written
    assert "Table III: Strehl ratio" in text
    assert re.search(r"turbulence pole, rms +0\.98860, 59\.38 mas ", text)
    assert re.search(r"80 mas as the rms of a sinusoid +80\.00 mas ", text)
    assert " nm" not in text
    assert "797.0 nm" in (folder / "parameters.csv").read_text()  # CSV stays in nm
    tables = "table_ii.csv table_iii.csv parameters.csv paper_kalman.fits paper_hinf.fits"
    figures = "robustness.png robustness.pdf sigma.png sigma.pdf"
    assert {path.name for path in folder.iterdir()} == {*tables.split(), *figures.split()}
    with (folder / "table_iii.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 30
    assert float(rows[0]["paper_strehl_percent"]) == 22.4
    assert lbt.load_gain(folder / "paper_hinf.fits").recertify().passed


def test_the_papers_points_lie_on_our_curves(written):
    lines = {line.get_label(): line.get_xydata() for line in written[2].axes[0].get_lines()}
    assert len(lines) == 4
    for name in ("Kalman", "H∞"):
        ours, theirs = lines[name], sorted(map(tuple, lines[f"{name}, paper"]))
        assert ours[:, 0].tolist() == [error for error, _ in theirs]
        assert max(abs(ours[:, 1] - [strehl for _, strehl in theirs])) < 1.5  # points of percent


@pytest.fixture(scope="module")
def setup():
    return load_setup()


@pytest.mark.parametrize("found", [None, "1.0.3", "1.2.0"])
def test_without_the_extra_the_command_says_how_to_get_it(monkeypatch, tmp_path, capsys, found):
    def version(name):
        if name != "specula":
            return real(name)
        if found is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return found

    real = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", version)
    gain = tmp_path / "i.fits"
    lbt.save_gain(gain, lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5))
    for arguments in (
        ["end-to-end", CONFIG, str(gain), "-o", str(tmp_path / "run")],
        ["end-to-end", CONFIG, "--tables", "II", "-o", str(tmp_path / "table"), "--tables", "II"],
    ):
        assert main(arguments) == 2
        assert 'pip install "lbt-synth[e2e]"' in capsys.readouterr().err
    with pytest.raises(MissingExtraError) as caught:
        lbt.interop.run_end_to_end(lbt.load_config(CONFIG).end_to_end, None)
    assert caught.value.extra == "e2e"


def test_the_telemetry_of_a_run_has_its_mirror(monkeypatch, tmp_path, setup):
    shell = lbt.models.PositionLoop.from_bandwidth(
        natural_frequency_hz=20, damping=0.5, bandwidth_hz=150
    )
    slow = replace(setup.hardware, mirror=shell)
    run = make_run(replace(setup, modes=3, hardware=slow), frames=20)
    design = lbt.integrator(slow, gain=0.1)
    gain = lbt.save_gain(tmp_path / "i.fits", design)
    monkeypatch.setattr(paper, "specula_version", lambda: "1.1")
    seen = paper._telemetry(run, design, str(gain))
    seen = lbt.files.load_telemetry(lbt.files.save_telemetry(tmp_path / "t.fits", seen))
    assert np.array_equal(seen.hardware.mirror_taps, slow.mirror_taps)
    assert "with the mirror taps c" in seen.convention


def test_a_loop_that_ran_away_ends_in_words(monkeypatch, tmp_path, capsys, setup):
    """A pyramid out of its range returns the same slopes whatever the tilt."""
    run = make_run(replace(setup, modes=3), frames=100)
    lost = replace(run, residual_nm=1e9 * (1 + run.residual_nm), measurements=run.measurements)
    gain = lbt.save_gain(
        tmp_path / "i.fits", lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.1)
    )
    monkeypatch.setattr(paper, "specula_version", lambda: "1.1")
    monkeypatch.setattr(paper, "calibrate", lambda *_, **__: None)
    monkeypatch.setattr(paper.simulation, "run_end_to_end", lambda *_, **__: lost)
    assert main(["end-to-end", CONFIG, str(gain), "-o", str(tmp_path / "run")]) == 1
    captured = capsys.readouterr()
    assert "the loop ran away. Try more than 60 pixels" in captured.err
    assert captured.out == ""
    assert not list((tmp_path / "run").iterdir())


@pytest.mark.parametrize(
    "arguments", [["--seeds", "0"], ["--jobs", "0"], ["--seed", "-1"], ["nowhere.fits"]]
)
def test_bad_input_at_the_command_line(tmp_path, capsys, arguments):
    out = tmp_path / "table"
    assert main(["end-to-end", CONFIG, *arguments, "--tables", "II", "-o", str(out)]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("lbt-synth: error:")
    assert captured.out == ""
    assert not out.exists()


@needs_specula
def test_the_command_writes_telemetry_that_is_the_run(tmp_path, capsys):
    config, gain = small_config(tmp_path), tmp_path / "k.fits"
    lbt.save_gain(gain, lbt.kalman(lbt.load_config(config).plant))
    out = tmp_path / "run"
    arguments = ["end-to-end", str(config), str(gain), "-o", str(out)]
    arguments += ["--json"]
    assert main(arguments) == 0
    data = json.loads(capsys.readouterr().out)
    assert sorted(p.name for p in out.iterdir()) == ["run.png", "telemetry.fits"]
    telemetry = lbt.files.load_telemetry(out / "telemetry.fits")
    assert telemetry.metadata["strehl"] == data["strehl"]
    assert telemetry.commands.shape == (40, 20)
    assert np.std(telemetry.residual_nm[:, 0]) <= data["tip_rms_nm"] * (1 + 1e-12)
    # y(k+1) is the gain times the residual of frame k, plus noise
    y, phase = telemetry.measurements[1:, :2], telemetry.residual_nm[:-1, :2]
    assert np.sum(y * phase) / np.sum(phase**2) == pytest.approx(telemetry.sensor_gain)
    assert main(arguments[:-1]) == 0
    assert "Strehl ratio at 2.2 um" in capsys.readouterr().out


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
    for old in ("{axis: both, frequency_hz: 20.0", "{kind: sinusoid, axis: tip"):
        assert old in text
        moved = "{accelerometers: {m1: {motion_nm_per_nm: 2}}, "
        text = text.replace(old, moved + old[1:])
    file.write_text(text + SENSORS)
    gain, out = tmp_path / "sensors.fits", tmp_path / "run"
    lbt.save_gain(gain, lbt.load_config(file).design("kalman"))
    arguments = ["end-to-end", str(file), str(gain), "-o", str(out)]
    assert main(arguments) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "the fall-back filter of the gain file runs, without truth." in printed
    alone = lbt.load_config(small_config(tmp_path)).end_to_end
    with pytest.raises(ProblemError, match=r"moves a channel of the design \(m1\)"):
        mix_controller(alone, lbt.load_gain(gain))


@needs_specula
def test_a_table_that_was_killed_goes_on(tmp_path):
    config, out = small_config(tmp_path), tmp_path / "table"
    arguments = [sys.executable, "-m", "lbt_synth.cli.main", "end-to-end", str(config)]
    arguments += f"-o {out} --seeds 1 --tables II --jobs 2 --json".split()
    first = subprocess.Popen(arguments, stdout=subprocess.DEVNULL)
    end = time.monotonic() + 120
    while len(list(out.glob("cases/*.npz"))) < 2:
        assert first.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < end
        time.sleep(0.02)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    kept = {p.name: p.read_bytes() for p in out.glob("cases/*.npz")}
    assert 2 <= len(kept) < 6
    second = subprocess.run(arguments, capture_output=True, text=True, check=True, timeout=300)
    data = json.loads(second.stdout)
    assert data["runs"] == 6
    assert len(list(out.glob("cases/*.npz"))) == 6
    for name, content in kept.items():
        assert (out / "cases" / name).read_bytes() == content
    assert {(e["row"], e["method"]) for e in data["table_ii"]} == {
        (row, method)
        for row in ("no vibration", "vibration")
        for method in ("classical", "kalman", "hinf")
    }
    lines = (out / "table_ii.csv").read_text().splitlines()
    assert len(lines) == 7
