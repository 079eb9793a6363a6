"""The designs that the tests of many loops share."""

from dataclasses import replace

import numpy as np
import pytest
from support.ensembles import LINE, plant

import lbt_synth as lbt


@pytest.fixture(scope="module")
def kalman():
    return lbt.kalman(plant())


@pytest.fixture(scope="module")
def coupled():
    """A sensor turned by 30 degrees, and another diagonal vibration: no axis is independent."""
    turn = np.deg2rad(30)
    sensor = 0.9 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    lines = [replace(LINE, direction=(1, 2)), replace(LINE, frequency_hz=31, direction=(1, 0))]
    return lbt.kalman(plant(sensor_matrix=sensor, vibrations=lines))
