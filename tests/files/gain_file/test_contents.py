"""Polytopic, LQG and shaped designs, and infeasibility proofs, in gain files."""

from __future__ import annotations

import json
from dataclasses import astuple, replace

import numpy as np
import pytest
from support.intervals import IntervalDesigns
from support.lqg import shell, slow_plant
from support.shaping import (
    shaped_design,
)

import lbt_synth as lbt
from lbt_synth.storage.array_file import digest


@pytest.fixture(scope="module")
def made():
    return IntervalDesigns()


@pytest.mark.parametrize("ending", ["fits", "npz", "json"])
def test_round_trip(tmp_path, made, ending):
    design = made["hinf", 1.0]
    back = lbt.load_gain(lbt.save_gain(tmp_path / f"p.{ending}", design))
    assert isinstance(back, lbt.design.PolytopicDesign)
    for field in (
        "method",
        "norm",
        "half_width_hz",
        "bound_guaranteed",
        "worst_achieved",
        "worst_frequency_hz",
        "bound_programme",
        "gamma",
        "rms",
    ):
        assert getattr(back, field) == getattr(design, field)
    for name in "ABC":
        assert np.array_equal(getattr(back.predictor, name), getattr(design.predictor, name))
    assert back.problem.vibrations == design.problem.vibrations
    assert back.recertify().passed


def edited(tmp_path, design, change):
    path = lbt.save_gain(tmp_path / "p.json", design)
    document = json.loads(path.read_text())
    change(document)
    arrays = {k: np.array(v, dtype=float) for k, v in document["arrays"].items()}
    document["meta"]["digest"] = digest(arrays, document["meta"])
    path.write_text(json.dumps(document))
    return path


def test_a_tampered_file_is_not_verified(tmp_path, made, capsys):
    from lbt_synth.cli.main import main

    def promise(document):
        document["meta"]["interval"]["bound_guaranteed"] *= 0.98

    def bend(document):
        document["arrays"]["PREDICTOR_B"][0][0] *= 1.001

    def destabilise(document):
        document["arrays"]["PREDICTOR_A"] = (1.5 * np.eye(4)).tolist()

    for change in (promise, bend, destabilise):
        path = edited(tmp_path, made["hinf", 1.0], change)
        assert main(["verify", str(path)]) == 1
        assert "NOT VERIFIED" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("norm", "h2", "not of the norm h2"),
        ("worst_achieved", 0.0, "worst_achieved must be above 0"),
        ("bound_guaranteed", "low", "bound_guaranteed must be a number"),
        ("half_width_hz", 30.0, "decays at"),
        ("worst_frequency_hz", 500.0, "Nyquist"),
    ],
)
def test_nonsense_is_inconsistent(tmp_path, made, key, value, text):
    def change(document):
        document["meta"]["interval"][key] = value

    path = edited(tmp_path, made["hinf", 1.0], change)
    with pytest.raises(lbt.errors.GainFileError, match=f"inconsistent: .*{text}"):
        lbt.load_gain(path)


def test_a_file_without_its_plant_or_filter(tmp_path, made):
    def kind(document):
        document["meta"]["problem"] = "problem"

    def lost(document):
        del document["arrays"]["PREDICTOR_C"]

    def crooked(document):
        document["arrays"]["PREDICTOR_C"] = [[1.0, 2.0]]

    for change, text in (
        (kind, "needs a plant"),
        (lost, "PREDICTOR_C is missing"),
        (crooked, "C must have"),
    ):
        with pytest.raises(lbt.errors.GainFileError, match=text):
            lbt.load_gain(edited(tmp_path, made["hinf", 1.0], change))


@pytest.mark.parametrize("ending", ["fits", "npz", "json"])
@pytest.mark.parametrize("mirror", [None, "slow"])
def test_gain_files(tmp_path, ending, mirror):
    plant = slow_plant(2.0, shell() if mirror else None, modes=2)
    design = lbt.lqg(plant, command_weight=0.01)
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"x.{ending}", design))
    assert isinstance(loaded, lbt.design.LqgDesign)
    assert loaded.recertify().passed
    np.testing.assert_array_equal(loaded.controller.A, design.controller.A)
    np.testing.assert_array_equal(loaded.gain_mirror, design.gain_mirror)
    assert loaded.command_weight == 0.01
    assert loaded.objective_nm == design.objective_nm
    if mirror:
        assert astuple(loaded.hardware.mirror) == astuple(plant.hardware.mirror)
    else:
        assert loaded.hardware.mirror is None
    other = lbt.load_gain(lbt.save_gain(tmp_path / f"k.{ending}", lbt.kalman(plant)))
    assert other.recertify().passed
    np.testing.assert_array_equal(other.hardware.mirror_taps, plant.hardware.mirror_taps)


def test_a_gain_file_that_does_not_fit_its_mirror_is_refused(tmp_path):
    design = lbt.lqg(slow_plant(2.0, shell()))
    broken = replace(design, gain_mirror=design.gain_mirror[:-1])
    path = lbt.save_gain(tmp_path / "x.json", broken)
    with pytest.raises(lbt.errors.GainFileError, match="GAIN_MIRROR must be"):
        lbt.load_gain(path)


@pytest.fixture
def small():
    return shaped_design()


@pytest.mark.parametrize("ending", [".fits", ".npz", ".json"])
def test_a_shaped_design_returns_from_its_gain_file(small, tmp_path, ending):
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"gain{ending}", small))
    assert isinstance(loaded, lbt.design.ShapedDesign)
    assert loaded.recertify().passed
    assert loaded.objective_nm == small.objective_nm
    assert [d.label for d in loaded.specifications[0].demands] == [
        d.label for d in small.specifications[0].demands
    ]
    assert loaded.terms_nm() == small.terms_nm()
    np.testing.assert_array_equal(loaded.controller.A, small.controller.A)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(objective_nm=[-1.0]), "objective_nm must be above 0"),
        (lambda m: m.update(objective_nm=[0.0]), "objective_nm must be above 0"),
        (lambda m: m.update(long_objective_nm=["inf"]), "long_objective_nm must be a number"),
        (lambda m: m.update(objective_nm=[30.0, 30.0]), "one for each mode"),
        (
            lambda m: m.update(specifications=[{"kind": "ModulusMargin", "at_least": 0.5}]),
            "are none",
        ),
        (lambda m: m.update(specifications=[3]), "are none"),
        (
            lambda m: m["specifications"][0]["objective"]["terms"][1].update(high_hz=900.0),
            "below the Nyquist",
        ),
        (lambda m: m["specifications"][0].update(kind="Anything"), "Anything"),
    ],
)
def test_impossible_claims_of_a_gain_file_are_refused(small, tmp_path, change, message):
    path = lbt.save_gain(tmp_path / "gain.json", small)
    document = json.loads(path.read_text())
    change(document["meta"]["shaped"])
    arrays = {k: np.array(v) for k, v in document["arrays"].items()}
    meta = {k: v for k, v in document["meta"].items() if k != "digest"}
    document["meta"]["digest"] = digest(arrays, meta)
    path.write_text(json.dumps(document))
    with pytest.raises(lbt.errors.GainFileError, match=message):
        lbt.load_gain(path)


def test_the_proof_travels_with_the_gain_file(tmp_path, axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.1)
    for ending in (".fits", ".npz", ".json"):
        loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"g{ending}", design))
        assert loaded.gamma_infeasible == design.gamma_infeasible
        assert np.array_equal(loaded.witness.states, design.witness.states)
        assert loaded.recertify().passed
