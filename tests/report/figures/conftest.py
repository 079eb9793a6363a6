"""Designs that the figures draw."""

import pytest

import lbt_synth as lbt


@pytest.fixture
def designs(config):
    return {
        "Kalman": lbt.kalman(config.plant),
        "H-infinity": lbt.hinf(config.plant, gamma_ratio=1.2, route="riccati"),
        "integrator": lbt.integrator(config.hardware, gain=0.5),
    }
