"""The likelier of two optima of the sensor gain."""

from __future__ import annotations

import numpy as np
from support.recorded_loops import LINE, open_record, resonant_record, spliced_record

import lbt_synth as lbt
from lbt_synth.identification import likeliest_gain
from lbt_synth.identification.likeliest_gain import (
    agrees,
    identify_likeliest,
    identify_with_gains,
)


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


def test_model_and_gains_of_wide_resonances_agree() -> None:
    model, allowed = identify_with_gains(resonant_record())
    assert allowed is not None
    assert agrees(model, allowed)
    assert abs(model.sensor_gains[0] - 0.9) < 4 * (model.axes[0].sensor_gain_error or 0.0)


def test_gains_that_the_fit_excludes_do_not_count(monkeypatch) -> None:
    """The coarse spectrum may be wrong; a fit held at its gains is then much less likely."""
    record = spliced_record(lines=LINE)
    wrong = np.array([[1.6, 2.0]])
    monkeypatch.setattr(likeliest_gain, "allowed_gains", lambda *_: wrong)
    model, allowed = identify_with_gains(record)
    assert allowed is not None
    assert abs(model.sensor_gains[0] - 0.6) < 0.1
    np.testing.assert_allclose(allowed, model.sensor_gains[0])


def test_an_open_loop_or_a_given_gain_allows_no_interval() -> None:
    closed = spliced_record(lines=LINE)
    assert identify_with_gains(closed, sensor_gain=0.6)[1] is None
    assert identify_with_gains(open_record())[1] is None
