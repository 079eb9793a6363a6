"""The commands export and rehearse."""

import hashlib
import json
import re

import numpy as np
import pytest
from support.commands import run
from support.compiled import Compiled
from support.exports import lbt_designs
from support.plants import LBT_YAML

import lbt_synth as lbt


@pytest.fixture
def designs():
    return lbt_designs()


@pytest.fixture(scope="module")
def gains(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gains")
    names = ("kalman", "hinf", "integrator", "prior")
    return {name: lbt.save_gain(folder / f"{name}.fits", lbt_designs()[name]) for name in names}


def test_export_c_at_the_terminal(tmp_path, capsys, designs, gains):
    out = tmp_path / "ctl.c"
    sha256 = hashlib.sha256(gains["kalman"].read_bytes()).hexdigest()  # as `sha256sum` prints it
    status, text, error = run(
        capsys, "export", gains["kalman"], "--for", "c", "-o", out, "--precision", "single"
    )
    assert (status, error) == (0, "")
    assert re.search(r"(\d) of \1 checks passed\.", " ".join(text.split()))
    assert sha256 in out.read_text()
    certificate = json.loads((tmp_path / "ctl.c.certificate.json").read_text())
    assert certificate["gain_sha256"] == sha256
    ours = designs["kalman"].controller.start()
    assert np.allclose(Compiled(out, single=True).step([1, 2]), ours.step([1, 2]), rtol=1e-6)
    status, text, _ = run(
        capsys, "export", gains["kalman"], "--for", "c", "-o", out, "--name", "tip", "--json"
    )
    data = json.loads(text)
    assert status == 0
    endings = (".c", ".h", ".c.certificate.json")
    assert data["files"] == [str(out.with_suffix(ending)) for ending in endings]
    assert data["frame_cost"]["multiplications"] == 30
    assert data["gain_digest"] == sha256
    Compiled(out, name="tip")


BAD = [
    (("KALMAN", "--for", "matlab", "-o", "k.mat", "--name", "x"), 2, "--name goes with --for c"),
    (("KALMAN", "--for", "cacao", "-o", "k.mat"), 2, "must end in .fits"),
    (("PRIOR", "--for", "dao", "--order", "40", "-o", "k.npy"), 1, "must keep what its design"),
]


@pytest.mark.parametrize(("arguments", "expected", "text"), BAD)
def test_bad_input(tmp_path, capsys, monkeypatch, gains, arguments, expected, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DAMAGED.fits").write_bytes(gains["kalman"].read_bytes()[:4000])
    before = gains["kalman"].read_bytes()
    files = sorted(tmp_path.iterdir())
    names = {"KALMAN": gains["kalman"], "PRIOR": gains["prior"]}
    status, out, error = run(capsys, "export", *(names.get(a, a) for a in arguments))
    assert (status, out) == (expected, "")
    assert text in error
    assert "Traceback" not in error
    assert sorted(tmp_path.iterdir()) == files
    assert gains["kalman"].read_bytes() == before


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
    words = ("rehearse", folder / "night.fits", folder / "bare.fits", "--for", "dao")
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
    limited = (*words, "--stroke", 100, "--wavelength-um", 1.1, "--json")
    clipped = json.loads(run(capsys, *limited)[1])["loops"][0]
    assert clipped["largest_command_nm"] == 100
    assert clipped["clipped_frames"] > 0
    assert clipped["strehl"] < target["strehl"]


def test_the_file_that_made_a_record_leaves_what_ran(tmp_path, capsys):
    """The gain is what the raw measurement shows, in the file and in the record: 0.6, not 1."""
    config = tmp_path / "gain.yaml"
    text = LBT_YAML.read_text().replace("  sensor_gain: 1.0 ", "  sensor_gain: 0.6 ")
    config.write_text(text.replace("    kind: ar1\n", "    kind: ar1\n  sensor_gain: 0.6\n"))
    gain, night = tmp_path / "k.fits", tmp_path / "night.fits"
    assert run(capsys, "design", config, "--method", "kalman", "-o", gain)[0] == 0
    words = ("simulate", config, gain, "--frames", 6000, "--cases", 1, "--telemetry", night)
    assert run(capsys, *words)[0] == 0
    rehearsed = run(capsys, "rehearse", night, gain, "--for", "c", "--json")
    target, _, ran = json.loads(rehearsed[1])["loops"]
    assert target["residual_nm"] == pytest.approx(ran["residual_nm"], rel=1e-3)
    found = json.loads(run(capsys, "diagnose", night, gain, "--json")[1])
    rows = {row["name"]: row["data_nm"] for row in found["residuals"]}
    assert rows["k"] == pytest.approx(rows["what ran"], rel=2e-3)
    identified = lbt.identify(lbt.load_record(night))
    for axis in identified.axes:
        assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
