"""The FITS layout, read by a foreign state-space filter and by people."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from support.gain_files import DESIGNS

import lbt_synth as lbt


def state_space_filter(path):
    """Read a FITS file as SPECULA's state-space filter does, and return its step function.

    HDUs by name, new state first: x <- A x + B u, y = C x + D u.
    """
    with fits.open(path) as hdus:
        assert hdus[0].header.get("VERSION", 1) == 1
        assert hdus[0].data is None
        A, B, C, D = (hdus[name].data.copy() for name in "ABCD")
        assert hdus[0].header["NFILTER"] == B.shape[1]
        assert hdus[0].header["NSTATES"] == A.shape[0]
    assert C.shape == (B.shape[1], A.shape[0])
    assert D.shape == (B.shape[1], B.shape[1])
    x = np.zeros(len(A))

    def step(u):
        nonlocal x
        x = A @ x + B @ u
        return C @ x + D @ u

    return step


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_the_fits_file_drives_a_foreign_state_space_filter(tmp_path, name):
    design = DESIGNS[name]
    step = state_space_filter(lbt.save_gain(tmp_path / "g.fits", design))
    run = design.controller.start()
    for y in np.random.default_rng(0).standard_normal((100, 2)):
        assert np.allclose(step(y), run.step(y), rtol=1e-13, atol=1e-13)


def test_fits_headers_speak_to_people(tmp_path):
    header = fits.getheader(lbt.save_gain(tmp_path / "g.fits", DESIGNS["kalman"]))
    assert header["METHOD"] == "kalman"
    assert header["RATE_HZ"] == 800
    assert header["DELAY"] == 2.5
    assert header["NEWSTATE"] is True
    assert header["RMS"] == pytest.approx(DESIGNS["kalman"].rms)
