"""Shaped designs in gain files."""

import json

import numpy as np
import pytest
from support.shaping import (
    shaped_design,
)

import lbt_synth as lbt
from lbt_synth.storage.array_file import digest as _digest


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
    document["meta"]["digest"] = _digest(arrays, meta)
    path.write_text(json.dumps(document))
    with pytest.raises(lbt.errors.GainFileError, match=message):
        lbt.load_gain(path)
