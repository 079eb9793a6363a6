"""A small telescope whose end-to-end simulation takes seconds."""

from pathlib import Path

import pytest

import lbt_synth as lbt
from lbt_synth.interop.specula.optics import EndToEndSetup

PATH = lbt.LoopHardware(frame_rate_hz=800)
SETUP = EndToEndSetup(  # of a bright star
    hardware=PATH,
    diameter_m=1.5,
    obstruction=0.2,
    seeing_arcsec=0.02,
    outer_scale_m=10,
    wind_speed_m_s=5,
    sensing_wavelength_um=0.75,
    modulation_lambda_over_d=4,
    subapertures_across=8,
    photons=1e5,
    read_noise_electrons=0,
    modes=20,
    actuators_across=7,
    pixels=24,
    frames=400,
    settle_frames=200,
    gain=0.5,
    leak=1.0,
    leak_from_mode=2,
)
# a filter for 40 Hz leaves much of a line at 44 Hz
SHAKE = lbt.models.SinusoidalVibration(frequency_hz=44, rms_nm=60.0, direction=(0.8, 0.6))
AIR = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=0.5, frame_rate_hz=800)
LINES = [
    lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=20, direction=direction)
    for direction in ((1, 0), (0, 1))
]
PLANT = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=AIR, noise_nm=0.3, vibrations=LINES)


def small_config(folder):
    text = Path("examples/lbt.yaml").read_text()
    for old, new in (
        ("diameter_m: 8.22", "diameter_m: 1.5"),
        ("seeing_arcsec: 0.8 ", "seeing_arcsec: 0.1 "),
        ("subapertures_across: 30", "subapertures_across: 8"),
        ("photons: 50.0", "photons: 5000.0"),
        ("modes: 672", "modes: 20"),
        ("pixels: 60", "pixels: 24\n  actuators_across: 7"),
        ("frames: 1600", "frames: 40"),
        ("settle_frames: 400", "settle_frames: 200"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    file = folder / "small.yaml"
    file.write_text(text)
    return file


def needs_specula(test):
    """Mark a test that runs SPECULA."""
    ignore = pytest.mark.filterwarnings("ignore::DeprecationWarning:specula")
    return pytest.mark.e2e(ignore(test))
