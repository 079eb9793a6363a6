"""The command rehearse."""

import json

import numpy as np
import pytest
from support.commands import run
from support.plants import LBT_YAML

import lbt_synth as lbt


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A gain file with its configuration, one without, and a record of a loop at gain 0.7."""
    folder = tmp_path_factory.mktemp("files")
    config = lbt.load_config(LBT_YAML)
    slow = lbt.integrator(config.hardware, gain=0.3)
    lbt.save_gain(folder / "bare.fits", slow)
    lbt.save_gain(folder / "gain.fits", config.design("kalman"))
    air = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20.0, frame_rate_hz=800)
    truth = lbt.Truth(turbulence=air, noise_nm=5.0, sensor_gain=0.7)
    night = lbt.simulate(slow, truth, hardware=config.hardware, frames=2400)
    series = lbt.files.telemetry_from_simulation(night, config.hardware, imaging=config.imaging)
    lbt.files.save_telemetry(folder / "night.fits", series)
    return folder, night


def test_a_record_is_rehearsed_beside_what_ran(capsys, files):
    folder, night = files
    words = ("rehearse", folder / "bare.fits", "--for", "dao", "--record", folder / "night.fits")
    status, text, error = run(capsys, *words, "--sensor-gain", 0.7, "--json")
    assert (status, error) == (0, ""), error
    data = json.loads(text)
    target, design, ran = data["loops"]
    # the same controller on its own series: what it was, but for the start
    assert design["residual_nm"] == pytest.approx(ran["residual_nm"], rel=1e-3)
    assert target["residual_nm"] == pytest.approx(ran["residual_nm"], rel=1e-3)
    assert ran["clipped_frames"] is None
    frames = data["frames"]
    commands = night.commands[0][-frames:]
    assert ran["largest_command_nm"] == pytest.approx(np.max(np.abs(commands)))
    assert 0 < data["difference_rms_nm"] < data["difference_largest_nm"] < 0.01


def test_the_file_that_made_a_record_leaves_what_ran(tmp_path, capsys):
    """The gain is what the raw measurement shows, in the file and in the record: 0.6, not 1."""
    config = tmp_path / "gain.yaml"
    text = LBT_YAML.read_text().replace("  sensor_gain: 1.0 ", "  sensor_gain: 0.6 ")
    config.write_text(text.replace("    kind: ar1\n", "    kind: ar1\n  sensor_gain: 0.6\n"))
    gain, night = tmp_path / "k.fits", tmp_path / "night.fits"
    assert run(capsys, "design", config, "--method", "kalman", "-o", gain)[0] == 0
    words = ("simulate", config, gain, "--frames", 6000, "--cases", 1, "--telemetry", night)
    assert run(capsys, *words)[0] == 0
    rehearsed = run(capsys, "rehearse", gain, "--for", "c", "--record", night, "--json")
    target, _, ran = json.loads(rehearsed[1])["loops"]
    assert target["residual_nm"] == pytest.approx(ran["residual_nm"], rel=1e-3)
    found = json.loads(run(capsys, "diagnose", night, gain, "--json")[1])
    rows = {row["name"]: row["data_nm"] for row in found["residuals"]}
    assert rows["k"] == pytest.approx(rows["what ran"], rel=2e-3)
    identified = lbt.identify(lbt.load_record(night))
    for axis in identified.axes:
        assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)


def test_without_a_record_the_truth_of_the_file_is_drawn(tmp_path, capsys, files):
    gain, figure = files[0] / "gain.fits", tmp_path / "a.png"
    words = ("rehearse", gain, "--for", "dao", "--frames", 1500, "--stroke", 900)
    status, text, error = run(capsys, *words, "--unit", "mas", "-o", figure)
    assert (status, error) == (0, "")
    assert "1500 frames of its own truth; Strehl ratio at 2.2 um" in text
    assert "residual [mas rms]" in text
    assert "what ran" not in text
    assert figure.read_bytes().startswith(b"\x89PNG")
    data = json.loads(run(capsys, *words, "--json")[1])
    assert data["loops"][0]["largest_command_nm"] == 900
    assert data["loops"][0]["clipped_frames"] > 0
    _, text, _ = run(capsys, *words, "--wavelength-um", 1.1, "--json")
    blue = json.loads(text)["loops"][0]
    assert blue["residual_nm"] == data["loops"][0]["residual_nm"]
    assert blue["strehl"] < data["loops"][0]["strehl"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("bare.fits", "--for", "dao"), "holds no configuration to draw"),
        (("gain.fits", "--for", "dao", "--record", "none.fits"), "none.fits"),
        (("gain.fits", "--for", "doa"), "invalid choice"),
        (("gain.fits", "--for", "dao", "--frames", "-1"), "--frames must be at least 1; got -1"),
        (("gain.fits", "--for", "dao", "--stroke", "1e300"), "--stroke must be at most 1e+30"),
        (("gain.fits", "--for", "dao", "--frames", "0"), "--frames must be at least 1; got 0"),
        (("gain.fits", "--for", "dao", "--kind", "open-loop"), "--kind goes with --record"),
        (("gain.fits", "--for", "dao", "--sensor-gain", "0.5"), "--sensor-gain goes with --record"),
        (("gain.fits", "--for", "dao", "--swap-axes"), "--swap-axes goes with --record"),
        (
            ("gain.fits", "--for", "dao", "--record", "night.fits", "--frames", "900"),
            "--frames goes without --record",
        ),
        (("gain.fits", "--for", "dao", "--wavelength-um", "0"), "--wavelength-um must be above 0"),
    ],
)
def test_what_is_missing_is_said(capsys, monkeypatch, files, words, message):
    monkeypatch.chdir(files[0])
    status, _, error = run(capsys, "rehearse", *words)
    assert status == 2
    assert message in error
