"""The best integrator of a plant, against that of its truth."""

from __future__ import annotations

import pytest
from support.replays import (
    a_plant,
    a_truth,
)

import lbt_synth as lbt


def test_the_integrator_of_a_plant_is_that_of_its_truth():
    plant = a_plant()
    own, other = (
        lbt.design.model_integrator(plant),
        lbt.design.optimal_integrator(plant.hardware, a_truth()),
    )
    assert own.gain == pytest.approx(other.gain, rel=1e-5)
    assert own.certificate.passed
