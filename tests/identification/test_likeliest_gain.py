"""The likelier of two optima of the sensor gain."""

from __future__ import annotations

import numpy as np
from support.recorded_loops import LINE, spliced_record

import lbt_synth as lbt
from lbt_synth.identification.likeliest_gain import agrees, identify_likeliest


def test_a_model_that_agrees_is_kept() -> None:
    record = spliced_record(lines=LINE)
    plain = lbt.identify(record)
    assert agrees(plain, np.array([[0.5, 0.7]]))
    assert not agrees(plain, np.array([[0.05, 0.1]]))
    for allowed in (None, np.array([[0.5, 0.7]])):
        model = identify_likeliest(record, allowed=allowed)
        assert model.sensor_gains == plain.sensor_gains


def test_another_start_is_tried_and_the_likelier_model_kept() -> None:
    record = spliced_record(lines=LINE)
    model = identify_likeliest(record, allowed=np.array([[0.05, 0.1]]))
    assert abs(model.sensor_gains[0] - 0.6) < 0.1  # the wrong interval does not win


def test_a_given_gain_stays() -> None:
    record = spliced_record(lines=LINE)
    model = identify_likeliest(record, allowed=np.array([[0.5, 0.7]]), sensor_gain=0.3)
    assert model.sensor_gains == (0.3,)
