"""The plants of an interval of frequencies."""

from __future__ import annotations

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.models.plant.frequency_interval import FrequencyInterval

RATE = 800


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


def test_the_plants_of_an_interval_are_a_segment(plant):
    interval = FrequencyInterval(plant=plant, half_width_hz=1.0)
    line = plant.vibrations[0]
    for f in (19.0, 19.3, 20.0, 21.0):
        model = lbt.Vibration(frequency_hz=f, damping=0.2 / f, rms_nm=1.0).ar_model(RATE)
        a1 = interval.coefficient(f)
        np.testing.assert_allclose([a1, -interval.retention], model.coefficients, rtol=1e-13)
        assert interval.frequency_hz(a1) == pytest.approx(f, rel=1e-11)
        A = interval.state_matrix(a1)
        np.testing.assert_allclose(A[0, :2], model.coefficients, rtol=1e-13)
        A = A.copy()
        A[0, 0] = plant.A[0, 0]
        np.testing.assert_allclose(A, plant.A, rtol=1e-13)
    assert interval.coefficients[0] < interval.coefficients[1]
    assert line.at_frequency(19.0).ar_model(RATE).rms_nm == pytest.approx(line.rms_nm, rel=1e-12)
