"""Weights of a generalised plant, against the product of their responses."""

from __future__ import annotations

import numpy as np
import pytest
from support.generalized_plants import random_plant

from lbt_synth.linear import StateSpace
from lbt_synth.linear.weights import Weight, constant_weight, stack_weights, weigh_plant


def lag(pole, count):
    """A lag on each of some channels, and its system."""
    one = Weight(*(np.array([[value]]) for value in (pole, 1.0, 0.5, 0.3)))
    weight = stack_weights([one] * count)
    return weight, StateSpace(**weight._asdict())


def test_weighted_plant_is_the_product_of_responses():
    plant = random_plant(2, n=4)
    m1, _, p1, _ = plant.sizes
    (left, left_system), (right, right_system) = lag(0.6, p1), lag(-0.4, m1)
    frequency_hz = np.linspace(0.02, 0.48, 7)
    G, L, R = (
        system.frequency_response(frequency_hz)
        for system in (plant.whole, left_system, right_system)
    )
    G[:, :p1] = L @ G[:, :p1]
    G[:, :, :m1] = G[:, :, :m1] @ R
    found = weigh_plant(plant, left, right).whole.frequency_response(frequency_hz)
    assert found == pytest.approx(G, rel=1e-9)


def test_constant_weights_add_no_states():
    plant = random_plant(3, n=4)
    p1 = plant.sizes[2]
    weighted = weigh_plant(plant, constant_weight(2 * np.eye(p1)))
    assert np.array_equal(weighted.A, plant.A)
    assert np.array_equal(weighted.C1, 2 * plant.C1)
