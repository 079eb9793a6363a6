"""The commands export and rehearse."""

import hashlib
import json

import numpy as np
import pytest
from support.commands import run_done, run_json
from support.plants import LBT_YAML

import lbt_synth as lbt


def test_export_c_at_the_terminal(tmp_path, capsys, gains):
    out = tmp_path / "ctl.c"
    sha256 = hashlib.sha256(gains["kalman"].read_bytes()).hexdigest()  # as `sha256sum` prints it
    words = ("export", gains["kalman"], "--for", "c", "-o", out, "--precision", "single")
    data = run_json(capsys, *words, "--name", "tip")
    assert all(word in out.read_text() for word in (sha256, "int tip_step(", ", float\n"))
    certificate = json.loads((tmp_path / "ctl.c.certificate.json").read_text())
    assert certificate["gain_sha256"] == data["gain_digest"] == sha256
    endings = (".c", ".h", ".c.certificate.json")
    assert data["files"] == [str(out.with_suffix(ending)) for ending in endings]
    assert data["frame_cost"]["multiplications"] == 30


def test_a_record_is_rehearsed_beside_what_ran(tmp_path, capsys, config):
    """A gain file without a configuration, and a record of its loop at gain 0.7."""
    slow, path = lbt.integrator(config.hardware, gain=0.3), config.hardware
    air = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20.0, frame_rate_hz=800)
    truth = lbt.Truth(turbulence=air, noise_nm=5.0, sensor_gain=0.7)
    night = lbt.simulate(slow, truth, hardware=path, frames=2400)
    series = lbt.files.telemetry_from_simulation(night, path, imaging=config.imaging)
    record = lbt.files.save_telemetry(tmp_path / "night.fits", series)
    gain = lbt.save_gain(tmp_path / "bare.fits", slow)
    words = ("rehearse", record, gain, "--for", "dao")
    data = run_json(capsys, *words, "--sensor-gain", 0.7)
    target, design, ran = data["loops"]
    # the same controller on its own series: what it was, but for the start
    residuals = [loop["residual_nm"] for loop in (design, target)]
    assert residuals == pytest.approx([ran["residual_nm"]] * 2, rel=1e-3)
    largest = np.max(np.abs(night.commands[0][-data["frames"] :]))
    assert (ran["clipped_frames"], ran["largest_command_nm"]) == (None, pytest.approx(largest))
    assert 0 < data["difference_rms_nm"] < data["difference_largest_nm"] < 0.01
    clipped, *_ = run_json(capsys, *words, "--stroke", 100, "--wavelength-um", 1.1)["loops"]
    assert (clipped["largest_command_nm"], clipped["clipped_frames"] > 0) == (100, True)
    assert clipped["strehl"] < target["strehl"]


def test_the_file_that_made_a_record_leaves_what_ran(tmp_path, capsys):
    """The gain is what the raw measurement shows, in the file and in the record: 0.6, not 1."""
    config, gain, night = tmp_path / "gain.yaml", tmp_path / "k.fits", tmp_path / "night.fits"
    text = LBT_YAML.read_text().replace("  sensor_gain: 1.0 ", "  sensor_gain: 0.6 ")
    config.write_text(text.replace("    kind: ar1\n", "    kind: ar1\n  sensor_gain: 0.6\n"))
    lbt.save_gain(gain, lbt.load_config(config).design("kalman"))
    run_done(capsys, "simulate", config, gain, "--frames", 6000, "--cases", 1, "--telemetry", night)
    target, _, ran = run_json(capsys, "rehearse", night, gain, "--for", "c")["loops"]
    assert target["residual_nm"] == pytest.approx(ran["residual_nm"], rel=1e-3)
    rows = run_json(capsys, "diagnose", night, gain)["residuals"]
    left = {row["name"]: row["data_nm"] for row in rows}
    assert left["k"] == pytest.approx(left["what ran"], rel=2e-3)
    for axis in lbt.identify(lbt.load_record(night)).axes:
        assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
