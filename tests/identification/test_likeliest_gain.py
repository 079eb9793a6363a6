"""The likelier of two optima of the sensor gain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.recorded_loops import (
    LINE,
    drifting_record,
    open_record,
    resonant_record,
    spliced_record,
)

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


@pytest.mark.parametrize("seed", [0, 2, 337])
def test_a_drift_over_frozen_flow_does_not_carry_the_gain_away(seed: int) -> None:
    """It did, to 0.03: what the loop leaves is coloured noise over a line, at no gain at all."""
    model, allowed = identify_with_gains(drifting_record(seed))
    assert allowed is not None
    assert allowed[0, 0] < 0.5859 < allowed[0, 1]
    error = model.axes[0].sensor_gain_error
    assert error is not None
    assert model.sensor_gains[0] == pytest.approx(0.5859, abs=3 * error)
    assert error < 0.18  # gains of 0.52, 0.62 and 0.73 are nearly as likely with seed 2


def test_a_gain_that_was_not_found_is_one_that_the_record_allows() -> None:
    record = drifting_record(11, gain=0.3)
    assert lbt.identify(record).sensor_gains == (1.0,)
    model, allowed = identify_with_gains(record)
    assert allowed is not None
    assert allowed[0, 0] < model.sensor_gains[0] < allowed[0, 1] < 1
    assert any("does not find the sensor gain" in note for note in model.notes)


def _shift_gains(monkeypatch: pytest.MonkeyPatch, gain: float) -> None:
    """Let free fits end at a gain."""

    def shifted(record: lbt.identification.LoopRecord, **options: Any):
        model = lbt.identify(record, **options)
        if options.get("sensor_gain") is not None:
            return model
        return replace(model, axes=tuple(replace(a, sensor_gain=gain) for a in model.axes))

    monkeypatch.setattr(likeliest_gain, "identify", shifted)


@pytest.mark.parametrize("gain", [0.03, 4.0])
def test_a_gain_that_no_sensor_has_gives_way(monkeypatch: pytest.MonkeyPatch, gain: float) -> None:
    _shift_gains(monkeypatch, gain)
    record = spliced_record(lines=LINE)
    model, allowed = identify_with_gains(record)
    assert allowed is not None
    assert allowed[0, 0] < model.sensor_gains[0] < allowed[0, 1]
    assert any("which no sensor has" in note for note in model.notes)
    assert identify_likeliest(record, allowed=allowed).sensor_gains == model.sensor_gains


def test_an_implausible_gain_excludes_no_plausible_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    _shift_gains(monkeypatch, 0.12)
    _, allowed = identify_with_gains(spliced_record(lines=LINE))
    assert allowed is not None
    assert allowed[0, 0] < 0.6 < allowed[0, 1]


def test_where_only_implausible_gains_are_allowed_all_plausible_ones_are(monkeypatch) -> None:
    """They were believed: the design of such a record of ten seconds was unstable."""
    monkeypatch.setattr(likeliest_gain, "allowed_gains", lambda *_: np.array([[2.2, 2.5]]))
    model, allowed = identify_with_gains(drifting_record(11, gain=0.3))
    assert allowed is not None
    np.testing.assert_allclose(allowed, [[0.2, 2.5]])
    assert model.sensor_gains == (1.0,)
