"""Sequences that destabilise, run step by step."""

from __future__ import annotations

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.linear.moving_parameter.destabilising import destabilising_sequence
from lbt_synth.loop.closed_loop import checked_loop_matrices


def test_a_switch_between_two_nilpotent_matrices():
    """``A(0) A(1) = diag(0, 1.44)``, and with ends e from 0 and 1 it is ``1.44 (1 - e)^2`` or so."""
    A0, A1 = np.array([[0.0, 0.0], [1.2, 0.0]]), np.array([[0.0, 1.2], [-1.2, 0.0]])
    found = destabilising_sequence(A0, A1, low=1e-3, high=1.0, nominal=0.5)
    assert found.radius > 1
    assert 1e-3 < found.low < 0.5 < found.high < 1
    product = np.eye(2)
    for high in found.at_high:
        product = (A0 + (found.high if high else found.low) * A1) @ product
    assert abs(np.linalg.eigvals(product)).max() == pytest.approx(found.radius, abs=1e-12)


def test_a_loop_grows_under_the_sequence_and_not_at_its_ends():
    plant = lbt_axis_plant()
    controller = lbt.kalman(plant).controller
    A0, A1, *_ = checked_loop_matrices(plant.hardware, controller)
    low, high = lbt.loop.stable_sensor_gains(plant.hardware, controller)
    found = destabilising_sequence(A0, A1, low=low, high=high, nominal=1.0)
    period = np.eye(len(A0))
    for gain in np.where(found.at_high, found.high, found.low):
        period = (A0 + gain * A1) @ period
    many = np.linalg.matrix_power(period, int(20 / np.log(found.radius)))
    assert np.linalg.norm(many) > 1e6
    for gain in (found.low, found.high):
        assert np.linalg.norm(np.linalg.matrix_power(A0 + gain * A1, 100_000)) < 1e-6
    assert low < found.low < 1 < found.high < high


def test_none_is_found_where_there_is_none():
    one, gain = np.array([[1.0]]), np.array([[-0.5]])
    assert destabilising_sequence(one, gain, low=0.01, high=3.99, nominal=1.0) is None
