"""Designs that are stable at all sensor gains in question."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from support.recorded_loops import LINE, spliced_record

import lbt_synth as lbt
from lbt_synth.identification.commands.gain_interval import unstable_gains
from lbt_synth.identification.design_for_gains import design_for_gains, possible_gains
from lbt_synth.methods.registry import gain_robust_method
from lbt_synth.methods.request import PlantInputs, design_request


@pytest.fixture(scope="module")
def fit_model():
    record = spliced_record((0,), lines=LINE, frames=20_000, sensor_gain=0.9)
    return partial(lbt.identification.identify, record)


@pytest.fixture(scope="module")
def half(fit_model):
    return fit_model()


def kalman(model):
    return lbt.kalman(model.plant())


def hinf(model):
    return lbt.hinf(
        model.plant(), gamma_ratio=1.02, route="riccati"
    )  # its controller alone is unstable


def robust(model, gains):
    inputs = PlantInputs(plant=model.plant(), sensor_gains=gains)
    return design_request(gain_robust_method(), {}).build(inputs)


def fail(model, gains):
    raise lbt.errors.InfeasibleError("too much")


def test_gains_that_the_fit_shows_keep_the_design(fit_model, half):
    gain, error = half.axes[0].sensor_gain, half.axes[0].sensor_gain_error
    model, made, assumed = design_for_gains(fit_model, kalman, fail, half, np.array([[0.6, 1.2]]))
    assert made.method == "kalman"
    assert model.axes[0].sensor_gain == pytest.approx(gain, abs=error)
    (text,) = assumed
    assert "the loop is stable at all of these" in text
    halved = unstable_gains(made, 0.5 * possible_gains(np.array([[0.6, 1.2]]), model, half))
    assert ("recorded at half their size" in text) == (halved is not None)
    assert design_for_gains(fit_model, kalman, fail, half, None)[2] == ()


def test_gains_that_are_too_far_apart_take_robust_synthesis_or_no_design(fit_model, half):
    wide = np.array([[0.02, 0.4]])  # the fit is outside: both count
    with pytest.raises(lbt.errors.CertificateError, match="the record allows 0.02 to 0.9"):
        design_for_gains(fit_model, hinf, fail, half, wide)
    _, made, assumed = design_for_gains(fit_model, hinf, robust, half, wide)
    assert made.method == gain_robust_method()
    assert unstable_gains(made, possible_gains(wide, half)) is None
    assert "lies within 0.02 to 0.9" in assumed[0]
