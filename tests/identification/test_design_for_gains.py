"""Designs that are stable at all sensor gains in question."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.recorded_loops import LINE, spliced_record
from support.wrong_commands import record

import lbt_synth as lbt
from lbt_synth.identification.commands.gain_interval import unstable_gains
from lbt_synth.identification.design_for_gains import design_for_gains, possible_gains
from lbt_synth.methods.registry import gain_robust_method
from lbt_synth.methods.request import PlantInputs, design_request


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
    safe = design_for_gains(fit_model, kalman, fail, models, allowed, command_scale_known=True)
    assert safe.design.method == "kalman"
    assert safe.model.axes[0].sensor_gain == pytest.approx(gain, abs=error)
    (text,) = safe.assumptions
    assert "the loop is stable at all of these" in text
    assert "at the size that was applied, as was stated" in text
    assert safe.notes == ()
    free = design_for_gains(fit_model, kalman, fail, models, None, command_scale_known=False)
    assert free.assumptions == ()


def test_commands_of_unknown_scale_ask_for_stability_at_half_the_gain():
    line = ((60.0, 0.004, 100.0),)
    record = spliced_record((0,), lines=line, frames=20_000, sensor_gain=0.9)
    fit_model = cache(partial(lbt.identification.identify, record))
    first = fit_model()
    models, allowed = (fit_model(start=first), first), np.array([[0.8, 1.0]])
    made = partial(design_for_gains, fit_model, hinf, models=models, allowed=allowed)
    best = made(design_robustly=fail, command_scale_known=True)
    halves = possible_gains(np.array([[0.8, 1.0]]), first) * [0.5, 1.0]
    assert best.design.method == "hinf"
    assert best.notes == ()
    assert unstable_gains(best.design, halves) is not None
    safe = made(design_robustly=robust, command_scale_known=False)
    assert unstable_gains(safe.design, halves) is None
    assert "at half of them" in safe.assumptions[0]
    (note,) = safe.notes
    assert "--command-scale 1" in note
    with pytest.raises(lbt.errors.CertificateError, match="or say --command-scale 1"):
        design_for_gains(
            lambda **_: first,
            lambda _: best.design,
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
    safe = design_for_gains(fit_model, hinf, robust, models, wide, command_scale_known=True)
    assert safe.design.method == gain_robust_method()
    assert unstable_gains(safe.design, possible_gains(wide, half)) is None
    assert "lies within 0.02 to 0.9" in safe.assumptions[0]
