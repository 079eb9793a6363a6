"""A design that is stable at all sensor gains that a record and its model allow."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import CertificateError, SynthesisError
from lbt_synth.identification.commands.gain_interval import unstable_gains
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.likeliest_gain import agrees
from lbt_synth.validation import FloatArray

_APART = 3.0  # standard errors of a gain that are allowed
_CAREFUL = 1.4  # by which a design's gain is below the largest that a record allows
_HALF = 0.5  # of the gains are left of commands recorded at half their size


def possible_gains(allowed: FloatArray, *models: IdentifiedModel) -> FloatArray:
    """Return the interval of gains of each axis that the record and its models allow.

    Where the fit finds the gains, near those that the record allows, its errors decide.
    """
    found = []
    for each in models:
        errors = [_APART * (axis.sensor_gain_error or 0.0) for axis in each.axes]
        gains = np.array(each.sensor_gains)
        found += [gains - np.minimum(errors, gains / 2), gains + errors]
    known = all(axis.sensor_gain_error is not None for each in models for axis in each.axes)
    if not (known and all(agrees(each, allowed) for each in models)):
        found += list(allowed.T)
    return np.column_stack([np.min(found, axis=0), np.max(found, axis=0)])


def is_stable_at_gains(design: Design, allowed: FloatArray, model: IdentifiedModel) -> bool:
    """Return whether a design is stable at all sensor gains that record and model allow."""
    return unstable_gains(design, possible_gains(allowed, model)) is None


def design_for_gains(
    fit_model: Callable[..., IdentifiedModel],
    design: Callable[[IdentifiedModel], Design],
    design_robustly: Callable[[IdentifiedModel, tuple[float, float]], Design],
    half: IdentifiedModel,
    allowed: FloatArray | None,
) -> tuple[IdentifiedModel, Design, tuple[str, ...]]:
    """Return model and design, stable at all possible gains, and what is assumed of them."""
    model = fit_model(start=half)
    made = design(model)
    if allowed is None:
        return model, made, ()
    intervals = possible_gains(allowed, model, half)
    bad = unstable_gains(made, intervals)
    first = model, bad
    for gain in _careful_gains(intervals):
        if bad is None:
            break
        model = fit_model(start=model, sensor_gain=gain)
        made = design(model)
        bad = unstable_gains(made, intervals)
    if bad is not None:
        model, bad = first
        made = _robust(model, bad, intervals, design_robustly)
    assumed = (
        f"the sensor gain lies within {_words(intervals)}, as the record and its model allow; the "
        "loop is stable at all of these"
    )
    if unstable_gains(made, intervals * _HALF) is not None:
        assumed += (
            ". The commands are those that were applied: if they were recorded at half their size, "
            "the loop would be unstable"
        )
    return model, made, (assumed,)


def _careful_gains(intervals: FloatArray) -> list[float]:
    """Return gains for designs that may be stable within intervals, the slowest first."""
    low, high = float(np.min(intervals)), float(np.max(intervals))
    return [high / _CAREFUL, float(np.sqrt(low * high)) * _CAREFUL, float(np.sqrt(low * high))]


def _robust(
    model: IdentifiedModel,
    bad: FloatArray | None,
    intervals: FloatArray,
    design_robustly: Callable[[IdentifiedModel, tuple[float, float]], Design],
) -> Design:
    """Return a design by robust synthesis, or refuse with the gains that are bad for another."""
    factors = intervals / np.array(model.sensor_gains)[:, None]
    try:
        found = design_robustly(model, (float(np.min(factors)), float(np.max(factors))))
        if unstable_gains(found, intervals) is None:
            return found
    except SynthesisError:
        pass  # the refusal says what the record lacks
    assert bad is not None
    gain = ", ".join(f"{value:.3g}" for value in bad)
    raise CertificateError(
        f"the loop of the design is unstable at the sensor gain {gain}, and the record allows "
        f"{_words(intervals)}. Record with a higher loop gain, look for jumps in the record, or "
        "give the sensor gain."
    )


def _words(intervals: FloatArray) -> str:
    return " and ".join(dict.fromkeys(f"{low:.3g} to {high:.3g}" for low, high in intervals))
