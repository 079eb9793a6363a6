"""LQG designs in gain files."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from support.lqg import shell, slow_plant

import lbt_synth as lbt


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
