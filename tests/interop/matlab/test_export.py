"""MATLAB files, read back; test_pipeline steps them."""

import numpy as np
import pytest
from scipy.io import loadmat
from support.exports import bare_design

import lbt_synth as lbt


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_matlab_round_trip(tmp_path, designs, name):
    design = designs[name]
    written = lbt.interop.export(tmp_path / "k.mat", design, "matlab", gain_digest="cd" * 32)
    assert written.files[0].read_bytes().startswith(b"MATLAB 5.0 MAT-file")
    data = loadmat(written.files[0], simplify_cells=True)
    for key in "ABCD":
        assert np.array_equal(data["new_state"][key], getattr(design.controller, key))
    form, (A, B, C, D) = data["textbook"], (getattr(design.controller, key) for key in "ABCD")
    expected = {"A": A, "B": B, "C": C @ A, "D": C @ B + D}
    assert all(np.array_equal(form[key], matrix) for key, matrix in expected.items())
    assert data["dt_s"] == design.controller.dt_s
    assert (data["frame_rate_hz"], data["delay_frames"]) == (800, 2)
    assert "ss(textbook.A, textbook.B, textbook.C, textbook.D, dt_s)" in data["convention"]
    assert "cd" * 32 in data["provenance"]
    assert written.error < 1e-13


def test_matlab_file_of_a_bare_problem(tmp_path):
    odd = lbt.Controller(A=[[0.5]], B=[[1.0, 2.0, 3.0]], C=[[1.0], [4.0]], D=np.zeros((2, 3)))
    data = loadmat(lbt.interop.export(tmp_path / "k.mat", bare_design(odd), "matlab").files[0])
    assert data["textbook"]["D"][0, 0].tolist() == [[1, 2, 3], [4, 8, 12]]
    assert "frame_rate_hz" not in data
