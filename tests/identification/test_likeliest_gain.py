"""The likelier of two optima of the sensor gain.

The sensor gains that a record allows, and designs at them.

Designs that are stable at all sensor gains in question.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.recorded_loops import (
    LINE,
    drifting_record,
    open_record,
    resonant_record,
    spliced_record,
)
from support.wrong_commands import record

import lbt_synth as lbt
from lbt_synth.identification import likeliest_gain
from lbt_synth.identification.likeliest_gain import (
    agrees,
    allowed_gains,
    design_for_gains,
    identify_likeliest,
    identify_with_gains,
    possible_gains,
    unstable_gains,
)
from lbt_synth.methods.registry import gain_robust_method
from lbt_synth.methods.request import PlantInputs, design_request


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
    assert error < 0.18


def _shift_gains(monkeypatch: pytest.MonkeyPatch, gain: float, **changes: Any) -> None:
    """Let free fits end at a gain, with other changes of their axes."""

    def shifted(record: lbt.identification.LoopRecord, **options: Any):
        model = lbt.identify(record, **options)
        if options.get("sensor_gain") is not None:
            return model
        moved = (replace(axis, sensor_gain=gain, **changes) for axis in model.axes)
        return replace(model, axes=tuple(moved))

    monkeypatch.setattr(likeliest_gain, "identify", shifted)


def test_a_gain_that_was_not_found_is_one_that_the_record_allows(monkeypatch) -> None:
    _shift_gains(monkeypatch, 1.0, sensor_gain_error=None)
    model, allowed = identify_with_gains(spliced_record(lines=LINE))
    assert allowed is not None
    assert allowed[0, 0] < model.sensor_gains[0] < allowed[0, 1] < 1
    assert any("does not find the sensor gain" in note for note in model.notes)


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
    _shift_gains(monkeypatch, 1.0, sensor_gain_error=None)
    model, allowed = identify_with_gains(spliced_record(lines=LINE))
    assert allowed is not None
    np.testing.assert_allclose(allowed, [[0.2, 2.5]])
    assert model.sensor_gains == (1.0,)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_true_gain_is_allowed(seed) -> None:
    low, high = allowed_gains(record(*ordinary_loop(seed))).T
    assert np.all(low < 0.7)
    assert np.all(high > 0.7)
    assert np.all(high / low < 2)


def test_wide_resonances_are_known_from_a_model() -> None:
    """The coarse spectrum alone explains them by a gain of 1.4 to 2, where the truth is 0.9."""
    resonant = resonant_record()
    assert np.all(allowed_gains(resonant)[:, 0] > 1.3)
    low, high = allowed_gains(resonant, lbt.identify(resonant)).T
    assert np.all(low < 1.3 * 0.9)
    assert np.all(high > 0.9 / 1.3)
    assert np.all(high / low < 1.6)


def test_a_record_that_shows_nothing_allows_everything() -> None:
    y, u = ordinary_loop()
    y = y.copy()
    y[::400] = np.nan
    assert allowed_gains(record(y, u)).tolist() == [[0.08, 2.5]] * 2


def test_gains_at_which_a_loop_is_unstable() -> None:
    """An integrator of gain g is stable below a sensor gain of 1 / g."""
    path = lbt.LoopHardware(frame_rate_hz=1000)
    design = lbt.integrator(path, gain=0.5)
    assert unstable_gains(design, np.array([[0.1, 1.99], [0.2, 1.99]])) is None
    bad = unstable_gains(design, np.array([[0.1, 1.0], [0.2, 2.01]]))
    assert bad is not None
    assert bad[1] == 2.01


@pytest.fixture(scope="module")
def fit_model():
    """Return what fits a model to one record, each start and gain once."""
    record = spliced_record((0,), lines=LINE, frames=20_000, sensor_gain=0.9)
    return cache(partial(lbt.identification.identify, record))


@pytest.fixture(scope="module")
def half(fit_model):
    return fit_model()


@pytest.fixture(scope="module")
def models(fit_model, half):
    return fit_model(start=half), half


def kalman(model):
    return lbt.kalman(model.plant())


@cache
def hinf(model):
    return lbt.hinf(
        model.plant(), gamma_ratio=1.02, route="riccati"
    )  # its controller alone is unstable


def robust(model, gains):
    inputs = PlantInputs(plant=model.plant(), sensor_gains=gains)
    return design_request(gain_robust_method(), {}).build(inputs)


def fail(model, gains):
    raise lbt.errors.InfeasibleError("too much")


def test_gains_that_the_fit_shows_keep_the_design(fit_model, half, models):
    gain, error = half.axes[0].sensor_gain, half.axes[0].sensor_gain_error
    allowed = np.array([[0.6, 1.2]])
    model, design, notes = design_for_gains(
        fit_model, kalman, fail, models, allowed, command_scale_known=True
    )
    assert design.method == "kalman"
    assert model.axes[0].sensor_gain == pytest.approx(gain, abs=error)
    (text,) = design.assumptions
    assert "the loop is stable at all of these" in text
    assert "at the size that was applied, as was stated" in text
    assert notes == ()
    _, free, _ = design_for_gains(fit_model, kalman, fail, models, None, command_scale_known=False)
    assert free.assumptions == ()


def test_commands_of_unknown_scale_ask_for_stability_at_half_the_gain():
    line = ((60.0, 0.004, 100.0),)
    record = spliced_record((0,), lines=line, frames=20_000, sensor_gain=0.9)
    fit_model = cache(partial(lbt.identification.identify, record))
    first = fit_model()
    models, allowed = (fit_model(start=first), first), np.array([[0.8, 1.0]])
    made = partial(design_for_gains, fit_model, hinf, models=models, allowed=allowed)
    _, best, notes = made(design_robustly=fail, command_scale_known=True)
    halves = possible_gains(np.array([[0.8, 1.0]]), first) * [0.5, 1.0]
    assert best.method == "hinf"
    assert notes == ()
    assert unstable_gains(best, halves) is not None
    _, safe, (note,) = made(design_robustly=robust, command_scale_known=False)
    assert unstable_gains(safe, halves) is None
    assert "at half of them" in safe.assumptions[0]
    assert "--command-scale 1" in note
    with pytest.raises(lbt.errors.CertificateError, match="or say --command-scale 1"):
        design_for_gains(
            lambda **_: first,
            lambda _: best,
            fail,
            (first, first),
            np.array([[0.8, 1.0]]),
            command_scale_known=False,
        )


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_axes_of_different_gains_may_have_those_of_both(size: float) -> None:
    """Commands of one axis at twice their size gave a design that was unstable in the loop."""
    y, u = ordinary_loop()
    made = lbt.design_from_record(record(y, u * [1.0, size]))
    gains = made.model.sensor_gains
    assert gains == pytest.approx((0.7, 0.7 / size), rel=0.15)
    assert "each axis at those of both, because they differ" in made.design.assumptions[0]
    assert unstable_gains(made.design, np.outer([1, 1], [min(gains), max(gains)])) is None
    assert any("recorded at another size" in note for note in made.model.notes)


def test_all_gains_count_that_the_record_or_a_model_allows(half):
    """A fit of 0.36 +- 0.04, beside an interval of 0.37 to 0.76, had the truth at 0.6."""
    gain, error = half.axes[0].sensor_gain, half.axes[0].sensor_gain_error
    (interval,) = possible_gains(np.array([[1.01 * gain, 2 * gain]]), half)
    assert interval == pytest.approx([gain - 3 * error, 2 * gain])
    (interval,) = possible_gains(np.array([[gain, 2 * gain]]), half)  # the fit is one of them
    assert interval == pytest.approx([gain - 3 * error, 1.5 * gain])
    (interval,) = possible_gains(np.array([[gain - error, gain + error]]), half)
    assert interval == pytest.approx([gain - 3 * error, gain + 3 * error])
    odd = replace(half, axes=tuple(replace(axis, sensor_gain=1.5) for axis in half.axes))
    (interval,) = possible_gains(np.array([[0.6, 2.0]]), odd)  # an implausible one narrows nothing
    assert interval == pytest.approx([0.6, 2.0])


def test_gains_of_models_that_are_as_likely_count(half) -> None:
    """A record of 20 s allowed 1.0 to 1.6, and its fits 0.4 to 1.5; the truth was 0.41."""
    rivals = replace(half, axes=tuple(replace(a, likely_gains=(0.1, 1.5)) for a in half.axes))
    allowed = np.array([[0.5, 0.7]])
    (interval,) = possible_gains(allowed, half, rivals)
    assert interval == pytest.approx([0.1, 1.5])


def test_no_robust_design_without_a_line_is_a_refusal_of_the_record(fit_model, models) -> None:
    def refuse(*_):
        raise lbt.errors.ProblemError("a robust controller is for vibrations; the plant has none.")

    wide = np.array([[0.02, 0.4]])
    with pytest.raises(lbt.errors.CertificateError, match="the record allows 0.02 to 0.9"):
        design_for_gains(fit_model, hinf, refuse, models, wide, command_scale_known=True)


def test_gains_that_are_too_far_apart_take_robust_synthesis_or_no_design(fit_model, half, models):
    wide = np.array([[0.02, 0.4]])  # the fit is outside: both count
    with pytest.raises(lbt.errors.CertificateError, match="the record allows 0.02 to 0.9"):
        design_for_gains(fit_model, hinf, fail, models, wide, command_scale_known=True)
    _, safe, _ = design_for_gains(fit_model, hinf, robust, models, wide, command_scale_known=True)
    assert safe.method == gain_robust_method()
    assert unstable_gains(safe, possible_gains(wide, half)) is None
    assert "lies within 0.02 to 0.9" in safe.assumptions[0]
