"""Designs for the LBT that the tests of all exports share."""

import pytest
from support.exports import lbt_designs

import lbt_synth as lbt
from lbt_synth.interop import proof


@pytest.fixture
def designs():
    return lbt_designs()


@pytest.fixture
def short_rehearsal(monkeypatch):
    """Rehearse few frames, in tests that do not look at what is found there."""
    monkeypatch.setattr(proof, "FRAMES", 100)


@pytest.fixture(scope="session")
def shaped():
    """A robust design of one mode, of some ten states."""
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=20.0, modes=1)
    line = lbt.design.shaping.VibrationBand(low_hz=18, high_hz=22, rms_nm=100)
    gains = {"sensor_gain": (0.5, 1.2), "scenarios": (1.0, 0.6)}
    return lbt.robust(plant, bands=[line], functions=12, states=None, **gains)
