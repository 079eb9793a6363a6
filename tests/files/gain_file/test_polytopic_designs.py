"""Polytopic designs in gain files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.intervals import interval_designs
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.storage.array_file import digest


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


@pytest.fixture(scope="module")
def made():
    return interval_designs()


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
