"""The proof of the infeasible level in gain files."""

from __future__ import annotations

import numpy as np

import lbt_synth as lbt


def test_the_proof_travels_with_the_gain_file(tmp_path, axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.1)
    for ending in (".fits", ".npz", ".json"):
        loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"g{ending}", design))
        assert loaded.gamma_infeasible == design.gamma_infeasible
        assert np.array_equal(loaded.witness.states, design.witness.states)
        assert loaded.recertify().passed
