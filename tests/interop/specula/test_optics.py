"""Modes, slopes and images of SPECULA's optics."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.refusals import require_refusals
from support.small_telescope import SETUP, needs_specula

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.interop.specula.optics import Optics, make_modes


@needs_specula
def test_the_modes_are_orthonormal_and_the_first_are_tip_and_tilt(calibration):
    modes = calibration.modes
    gram = modes.shapes @ modes.shapes.T / modes.shapes.shape[1]
    assert np.allclose(gram, np.eye(20), atol=1e-4)
    assert np.allclose(modes.shapes.mean(axis=1), 0, atol=1e-4)
    rows, columns = np.nonzero(modes.mask)
    plane = np.stack([np.ones(rows.size), rows, columns])
    for tilt in modes.shapes[:2]:
        left = tilt - plane.T @ np.linalg.lstsq(plane.T, tilt, rcond=None)[0]
        # as far as the mirror's actuators can make a plane
        assert np.std(left) < 0.05
    # a pupil of 1.5 m with an obstruction of 0.3 m
    lit = np.pi / 4 * 24**2 * (1 - 0.2**2)
    assert abs(modes.mask.sum() / lit - 1) < 0.05


@needs_specula
def test_a_small_phase_is_reconstructed_whatever_its_mode(calibration):
    optics = Optics(SETUP, calibration.modes)
    rng = np.random.default_rng(0)
    phase = rng.normal(scale=2.0, size=20)
    slopes = optics.expose(-phase, [0, 0]) - calibration.reference
    found = calibration.reconstructor @ slopes
    assert np.allclose(found, phase, atol=0.05 * np.abs(phase).max())
    # the mirror subtracts, a vibration adds, and the phase is what is left
    optics.expose(np.r_[3.0, np.zeros(19)], [5.0, 7.0])
    assert np.allclose(calibration.modes.coefficients(optics.phase_nm())[:3], [2, 7, 0], atol=1e-3)
    strehl, image = optics.image()
    rms = np.std(optics.phase_nm())
    assert strehl == pytest.approx(np.exp(-((2 * np.pi * rms / 2200) ** 2)), rel=1e-4)
    assert image.sum() == pytest.approx(1, rel=1e-5)


@needs_specula
def test_too_many_modes_for_the_mirror():
    with pytest.raises(ProblemError, match="40 modes need a mirror with more actuators"):
        make_modes(replace(SETUP, modes=40))


def test_systems_that_are_refused(setup):
    path = partial(lbt.LoopHardware, frame_rate_hz=800)
    changes = [({"pixels": pixels}, "pixels must be even") for pixels in (61, 20, 2000)]
    changes += [({"diameter_m": 0}, "diameter_m"), ({"hardware": path(modes=3)}, "two modes")]
    changes += [({"hardware": path(sensor_matrix=2 * np.eye(2))}, "sensor_matrix")]
    require_refusals([(partial(replace, setup, **c), ProblemError, words) for c, words in changes])


def test_a_phase_screen_is_longer_than_the_way_of_the_wind(setup):
    for frames in (10, 2000, 20000):
        run = replace(setup, frames=frames)
        length = run.screen_pixels * run.pixel_m
        assert length > (frames + setup.settle_frames) / 800 * 20 + 2 * 8.22
        assert length > 6 * 22


def test_seeing_at_another_wavelength(setup):
    infrared = replace(setup, seeing_wavelength_um=2.2, seeing_arcsec=0.5)
    assert infrared.reference_seeing_arcsec == pytest.approx(0.5 * (2.2 / 0.5) ** 0.2)
