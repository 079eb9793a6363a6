"""The folder that pyRTC starts from."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from ruamel.yaml import YAML
from support.exports import lbt_designs, with_controller
from support.gain_file_edits import odd_plant

import lbt_synth as lbt
from lbt_synth.interop.pyrtc.pol_filter import pol_filter

NAMES = ["config.yaml", "config.yaml.certificate.json", "gain.fits", "interaction_matrix.npz"]


def read(folder):
    return YAML(typ="safe").load(folder / "config.yaml")


def test_the_folder_holds_all_that_it_refers_to(tmp_path):
    design = lbt_designs()["kalman"]
    written = lbt.interop.export(tmp_path / "k", design, "pyrtc", gain_digest="a" * 64)
    assert sorted(path.name for path in (tmp_path / "k").iterdir()) == NAMES
    assert sorted(path.name for path in written.files) == NAMES
    assert 0 < written.error < 1e-6
    conf = read(tmp_path / "k")
    assert {"wfs", "slopes", "wfc", "loop"} <= set(conf)
    predictor = conf["loop"]["predictor"]
    assert (predictor["gain_file"], predictor["delay_frames"]) == ("gain.fits", 2)
    assert predictor["fit_frames"] == 16_000
    assert conf["loop"]["gain"] == 1.0
    assert conf["wfc"]["num_modes"] == conf["slopes"]["signal_size"] == 2
    again = lbt.load_gain(tmp_path / "k" / "gain.fits")
    assert np.array_equal(again.controller.A, design.controller.A)
    held = np.load(tmp_path / "k" / conf["loop"]["im_file"])
    assert np.array_equal(held["data"], np.eye(2))
    assert json.loads(str(held["pyrtc_calibration"]))["kind"] == "interaction_matrix"


def test_the_certificate_has_digests_and_checks(tmp_path):
    written = lbt.interop.export(tmp_path, lbt_designs()["hinf"], "pyrtc", gain_digest="b" * 64)
    found = json.loads((tmp_path / "config.yaml.certificate.json").read_text())
    assert found["gain_sha256"] == "b" * 64
    assert [check["passed"] for check in found["checks"]] == [True] * len(written.checks)
    assert found["arithmetic"]["precision"].startswith("single for signals")
    for name, digest in {found["file"]: found["file_sha256"], **found["others_sha256"]}.items():
        assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() == digest


def test_the_same_design_gives_the_same_bytes(tmp_path):
    for name in "ab":
        lbt.interop.export(tmp_path / name, lbt_designs()["integrator"], "pyrtc")
    for name in NAMES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_loop_of_more_modes_and_other_matrices(tmp_path):
    plant = odd_plant()
    lbt.interop.export(tmp_path, lbt.kalman(plant), "pyrtc", modes=4)
    assert read(tmp_path)["wfc"]["num_actuators"] == 4
    expected = np.eye(4)
    expected[:2, :2] = plant.hardware.sensor @ plant.hardware.influence
    assert np.array_equal(np.load(tmp_path / "interaction_matrix.npz")["data"], expected)


def test_what_is_refused_leaves_nothing(tmp_path, monkeypatch):
    design = lbt_designs()["integrator"]
    with pytest.raises(lbt.errors.ProblemError, match="modes must be at least 2"):
        lbt.interop.export(tmp_path / "k", design, "pyrtc", modes=1)
    wild = with_controller(design, lbt.integrator(design.hardware, gain=0.95).controller)
    held = (pol_filter(wild),)  # pyRTC computes another controller than that of the design
    own = replace(lbt.interop.target_named("pyrtc"), round=lambda *_, **__: [held])
    own = replace(own, read=lambda *_: held)
    monkeypatch.setattr("lbt_synth.interop.pyrtc.export.TARGET", own)
    with pytest.raises(lbt.errors.NumericalError, match=r"in the arithmetic of pyrtc .+ is"):
        lbt.interop.export(tmp_path / "k", design, "pyrtc")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "text"), [("file", "cannot make"), ("no/k", "cannot make")])
def test_a_folder_that_cannot_be_made_is_an_error(tmp_path, name, text):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(lbt.errors.OutputError, match=text):
        lbt.interop.export(tmp_path / name, lbt_designs()["integrator"], "pyrtc")
