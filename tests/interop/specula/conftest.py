"""The set-up of the LBT, and the cache and calibration of the small telescope."""

import pytest
from support.end_to_end import load_setup
from support.small_telescope import BRIGHT

import lbt_synth as lbt


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def calibration(cache):
    return lbt.interop.calibrate(BRIGHT, cache=cache)


@pytest.fixture(scope="module")
def setup():
    return load_setup()
