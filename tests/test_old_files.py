"""Gain files, telemetry, studies and configurations of version 0.1.0 load, and say the same."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import asdict
from functools import cache

import numpy as np
import pytest
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.cli.main import main

OLD = ROOT / "tests" / "data" / "version_0_1_0"
EXPECTED = json.loads((OLD / "expected.json").read_text())
TRUTHS = {"lqg.npz": "lbt_slow_mirror.yaml", "robust.npz": "lbt_robust.yaml"}
GAIN_FILES = sorted(name for name, entry in EXPECTED.items() if "spectral_radius" in entry)


@cache
def old_design(name):
    """The design of an old gain file, read once."""
    return lbt.load_gain(OLD / name)


def test_there_is_a_gain_file_of_each_method_and_format():
    assert len(GAIN_FILES) == 5
    assert {name.rpartition(".")[2] for name in GAIN_FILES} == {"fits", "npz"}


@pytest.mark.parametrize("name", GAIN_FILES)
def test_gain_files_load_and_close_the_same_loop(name):
    expected = EXPECTED[name]
    design = old_design(name)
    config = lbt.load_config(OLD / TRUTHS.get(name, "lbt.yaml"))
    loop = lbt.close_loop(config.hardware, design.controller)
    budget = lbt.residual_budget(loop, config.truth)
    assert type(design).__name__ == expected["kind"]
    assert all(check.passed for check in design.certificate.checks)
    found = {
        "residual_nm": budget.rms_nm,
        "spectral_radius": loop.spectral_radius,
        "modulus": lbt.loop_margins(loop).modulus,
        "strehl": lbt.strehl(budget, config.imaging),
    }
    for key, value in found.items():
        assert value == pytest.approx(expected[key], rel=1e-9), key


@pytest.mark.parametrize("name", GAIN_FILES)
def test_gain_files_pass_their_certificate_again(name, capsys):
    assert main(["verify", str(OLD / name)]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("name", GAIN_FILES)
@pytest.mark.parametrize("ending", ["fits", "npz"])
def test_gain_files_are_written_again_without_a_loss(name, ending, tmp_path):
    design = old_design(name)
    lbt.save_gain(tmp_path / f"again.{ending}", design)
    again = lbt.load_gain(tmp_path / f"again.{ending}")
    for matrix in "ABCD":
        old, new = (getattr(one.controller, matrix) for one in (design, again))
        assert np.array_equal(old, new)
    assert [asdict(check) for check in again.certificate.checks] == [
        asdict(check) for check in design.certificate.checks
    ]


@pytest.mark.parametrize("ending", ["fits", "npz"])
def test_telemetry_loads(ending):
    expected = EXPECTED["telemetry.fits"]
    telemetry = lbt.files.load_telemetry(OLD / f"telemetry.{ending}")
    assert telemetry.measurements.shape[0] == expected["frames"]
    assert telemetry.measurements.sum() == pytest.approx(expected["sum_of_measurements"], rel=1e-12)
    assert telemetry.commands.sum() == pytest.approx(expected["sum_of_commands"], rel=1e-12)


@pytest.mark.parametrize(
    "name", ["identified.yaml", "lbt.yaml", "lbt_robust.yaml", "lbt_slow_mirror.yaml"]
)
def test_configurations_load(name):
    config = lbt.load_config(OLD / name)
    assert config.hardware.frame_rate_hz == 800
    if name == "identified.yaml":
        expected = EXPECTED[name]["rms"]
        assert lbt.kalman(config.plant).rms == pytest.approx(expected, rel=1e-9)


@pytest.fixture
def old_study(tmp_path):
    shutil.copytree(OLD, tmp_path / "old")
    return tmp_path / "old" / "study.yaml"


def rows(path):
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_finished_study_is_read_and_not_computed_again(old_study, capsys):
    folder = old_study.parent / "study"
    before = (folder / "results.csv").read_bytes()
    assert main(["study", str(old_study), "-o", str(folder)]) == 0, capsys.readouterr().err
    assert (folder / "results.csv").read_bytes() == before
    assert (folder / "summary.html").exists()


def test_a_study_comes_out_the_same(old_study, tmp_path, capsys):
    assert main(["study", str(old_study), "-o", str(tmp_path / "new")]) == 0, capsys.readouterr()
    old, new = rows(OLD / "study" / "results.csv"), rows(tmp_path / "new" / "results.csv")
    assert len(old) == len(new) == 32
    for row, again in zip(old, new, strict=True):
        assert row.keys() == again.keys()
        for key, text in row.items():
            # the quadrature of the turbulence is finer than it was then
            assert float(again[key]) == pytest.approx(float(text), rel=1e-7, nan_ok=True), key


def test_a_row_of_a_study_is_computed_again(old_study, capsys):
    folder = old_study.parent / "study"
    assert main(["study", str(old_study), "-o", str(folder), "--row", "3"]) == 0
    assert "row" in capsys.readouterr().out
