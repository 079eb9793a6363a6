"""A design that is stable at all sensor gains that a record and its model allow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import CertificateError, ProblemError, SynthesisError
from lbt_synth.identification.commands.gain_interval import unstable_gains
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.loop import close_loop, residual_budget
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import FloatArray

_APART = 3.0  # standard errors of a gain that are allowed
_FARTHEST = 1.5  # factor by which a gain may be off that lies among those that a record allows
_CAREFUL = (0.9, 0.8)  # of the fitted gain: slower designs at little cost
_WIDE = 1.4  # by which the gain of a design is below the largest of a wide interval
_UNEVEN = 1.3  # ratio of the gains of two axes that one sensor hardly has
_HALF = 0.5  # of the gains are left of commands recorded at half their size


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SafeDesign:
    """A design that is stable at all possible gains, its model, and what is to be said of it."""

    model: IdentifiedModel
    design: Design
    assumptions: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def possible_gains(allowed: FloatArray, *models: IdentifiedModel) -> FloatArray:
    """Return the interval of gains of each axis that the record or its models allow.

    What a model leaves out moves its gain by more than its errors say. So all gains count that the
    record allows; where those of the fits are among them, and plausible, only the ones not too far
    from these. Gains of fits that are as likely count, too.
    """
    gains = np.array([each.sensor_gains for each in models])
    known = all(axis.sensor_gain_error is not None for each in models for axis in each.axes)
    low, high = allowed.T
    least, most = PLAUSIBLE_GAINS
    inside = (np.maximum(low, least) <= gains) & (gains <= np.minimum(high, most))
    if known and inside.all():
        low = np.maximum(low, gains.min(axis=0) / _FARTHEST)
        high = np.minimum(high, gains.max(axis=0) * _FARTHEST)
    found = [low, high]
    for own, each in zip(gains, models, strict=True):
        errors = [_APART * (axis.sensor_gain_error or 0.0) for axis in each.axes]
        found += [own - np.minimum(errors, own / 2), own + errors]
        likely = [axis.likely_gains or 2 * (axis.sensor_gain,) for axis in each.axes]
        found += list(np.transpose(likely))
    return np.column_stack([np.min(found, axis=0), np.max(found, axis=0)])


def is_stable_at_gains(design: Design, allowed: FloatArray, model: IdentifiedModel) -> bool:
    """Return whether a design is stable at all sensor gains that record and model allow."""
    return unstable_gains(design, possible_gains(allowed, model)) is None


def design_for_gains(
    fit_model: Callable[..., IdentifiedModel],
    design: Callable[[IdentifiedModel], Design],
    design_robustly: Callable[[IdentifiedModel, tuple[float, float]], Design],
    models: tuple[IdentifiedModel, IdentifiedModel],
    allowed: FloatArray | None,
    *,
    command_scale_known: bool,
) -> SafeDesign:
    """Return a design that is stable at all possible gains of two models, for the first of them.

    Commands that were recorded at half their size look like twice the sensor gain, and no record
    can tell; so half of the gains are possible, unless the scale of the commands is known. Where
    the axes have different gains, the commands of either may have another size than was recorded,
    and each axis may have the gains of both.
    """
    model, _ = models
    made = design(model)
    if allowed is None:
        return SafeDesign(model=model, design=made)
    intervals = possible_gains(allowed, *models)
    assumed = (
        f"the sensor gain lies within {_words(intervals)}, as the record and its model allow; the "
        "loop is stable at all of these"
    )
    known = intervals
    if command_scale_known:
        assumed += ". The commands were recorded at the size that was applied, as was stated"
    else:
        intervals = known * [_HALF, 1.0]
        assumed += " and at half of them, should the commands be recorded at half their size"
        if _are_uneven(model):
            low = np.minimum(intervals[:, 0], known.min())
            intervals = np.column_stack([low, np.full(len(low), known.max())])
            assumed += ", and each axis at those of both, because they differ"
    bad = unstable_gains(made, intervals)
    if bad is None:
        return SafeDesign(model=model, design=made, assumptions=(assumed,))
    used, careful = _design_carefully(fit_model, design, model, intervals)
    if careful is None:
        careful = _robust(model, bad, intervals, design_robustly, command_scale_known)
    note = (
        f"to be stable at sensor gains of {_words(intervals)}, the design leaves "
        f"{nm_text(_residual_nm(careful, model))} in the model; without that it would leave "
        f"{nm_text(_residual_nm(made, model))}"
    )
    if not command_scale_known and unstable_gains(made, known) is None:
        note += " (--command-scale 1: the commands were recorded at the size that was applied)"
    return SafeDesign(model=used, design=careful, assumptions=(assumed,), notes=(note,))


def _design_carefully(
    fit_model: Callable[..., IdentifiedModel],
    design: Callable[[IdentifiedModel], Design],
    model: IdentifiedModel,
    intervals: FloatArray,
) -> tuple[IdentifiedModel, Design | None]:
    """Return the first design for other gains that is stable within intervals, and its model."""
    low, high = float(np.min(intervals)), float(np.max(intervals))
    own = float(np.mean(model.sensor_gains))
    middle = float(np.sqrt(low * high))
    gains = [*(own * part for part in _CAREFUL), high / _WIDE, middle]
    if _are_uneven(model):
        gains.insert(0, max(model.sensor_gains))
    for gain in gains:
        fitted = fit_model(start=model, sensor_gain=gain)
        made = design(fitted)
        if unstable_gains(made, intervals) is None:
            return fitted, made
    return model, None


def _residual_nm(design: Design, model: IdentifiedModel) -> float:
    """Return what a design leaves in a model; infinite where its loop is unstable."""
    loop = close_loop(model.hardware, design.controller)
    return residual_budget(loop, model.truth()).rms_nm if loop.is_stable else np.inf


def _robust(
    model: IdentifiedModel,
    bad: FloatArray,
    intervals: FloatArray,
    design_robustly: Callable[[IdentifiedModel, tuple[float, float]], Design],
    command_scale_known: bool,
) -> Design:
    """Return a design by robust synthesis, or refuse with the gains that are bad for another."""
    factors = intervals / np.array(model.sensor_gains)[:, None]
    try:
        found = design_robustly(model, (float(np.min(factors)), float(np.max(factors))))
        if unstable_gains(found, intervals) is None:
            return found
    except (SynthesisError, ProblemError):  # a plant without lines has no such design
        pass  # the refusal says what the record lacks
    gain = ", ".join(f"{value:.3g}" for value in bad)
    advice = "" if command_scale_known else ", or say --command-scale 1 (recorded as applied)"
    raise CertificateError(
        f"the loop of the design is unstable at the sensor gain {gain}, and the record allows "
        f"{_words(intervals)}. Record with a higher loop gain, look for jumps in the record, "
        f"give the sensor gain{advice}."
    )


def _are_uneven(model: IdentifiedModel) -> bool:
    """Return whether the axes have gains that one sensor hardly has."""
    return max(model.sensor_gains) > _UNEVEN * min(model.sensor_gains)


def _words(intervals: FloatArray) -> str:
    return " and ".join(dict.fromkeys(f"{low:.3g} to {high:.3g}" for low, high in intervals))
