"""The set-up of the LBT, and the calibration of the small telescope."""

import pytest
from support.end_to_end import load_setup
from support.small_telescope import SETUP

from lbt_synth.interop.specula.optics import calibrate


@pytest.fixture(scope="session")
def calibration():
    return calibrate(SETUP)


@pytest.fixture(scope="module")
def setup():
    return load_setup()
