"""The sensor gains that a record allows, its likeliest model, and a design that all suit."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import CertificateError, NumericalError, ProblemError, SynthesisError
from lbt_synth.identification.commands.coarse_spectrum import CoarseRecord, dispersion
from lbt_synth.identification.commands.repair import CommandRepair
from lbt_synth.identification.commands.verdict import could_have_run, record_law
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS, POSSIBLE_GAINS, Search
from lbt_synth.identification.fit.identified_model import DIFFERENT, IdentifiedModel
from lbt_synth.identification.fit.identify import identify
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.loop import close_loop, residual_budget, stable_sensor_gains
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import FloatArray

_OUTSIDE = 1.3  # factor beyond an interval of gains
_LEAST, _MOST = POSSIBLE_GAINS
_FAR_STEPS = 16
_NEAR = np.geomspace(0.7, 1.43, 21)  # of the best gain, itself included
_FAR = 6.0  # nats below the best gain that a record still allows
_FARTHEST = 1.5  # factor by which a gain may be off that lies among those that a record allows
_CAREFUL = (0.9, 0.8)  # of the fitted gain: slower designs at little cost
_WIDE = 1.4  # by which the gain of a design is below the largest of a wide interval
_UNEVEN = 1.3  # ratio of the gains of two axes that one sensor hardly has
_HALF = 0.5  # of the gains are left of commands recorded at half their size


def identify_with_gains(
    record: LoopRecord, **options: Any
) -> tuple[IdentifiedModel, FloatArray | None]:
    """Identify a record; return the model and the sensor gains that it allows, (axes, 2).

    None for an open loop, or a gain that is given. Where the coarse spectrum asks for other gains
    than the fit, and a fit that is held at these is clearly less likely, the fit decides: but not
    where its own gain is implausible. A gain that no sensor has, or that was not found, gives way
    to the middle of those that the record allows; where these are implausible, to all plausible
    ones.
    ``options`` are those of :func:`identify`.
    """
    model = identify(record, **options)
    if record.commands is None or options.get("sensor_gain") is not None:
        return model, None
    allowed = allowed_gains(record, model)
    if agrees(model, allowed):
        return model, allowed
    low, high = PLAUSIBLE_GAINS
    if not _is_plausible(model):  # intervals without a plausible gain are widened to these
        odd = (allowed[:, :1] > high) | (allowed[:, 1:] < low)
        wider = [np.minimum(allowed[:, 0], low), np.maximum(allowed[:, 1], high)]
        allowed = np.where(odd, np.column_stack(wider), allowed)
    if agrees(model, allowed):
        return model, allowed
    best, excluded = _compare(record, model, allowed, options)
    if excluded and _is_plausible(best):
        allowed = np.repeat(np.array(best.sensor_gains)[:, None], 2, axis=1)
    return best, allowed


def identify_likeliest(
    record: LoopRecord, *, allowed: FloatArray | None, **options: Any
) -> IdentifiedModel:
    """Identify a record, from other sensor gains as well if the first is one that it excludes.

    Wide resonances may carry a fit to a gain far from the true one, where the likelihood has
    another optimum. ``allowed`` and ``options`` are those of :func:`identify_with_gains`.
    """
    model = identify(record, **options)
    if allowed is None or options.get("sensor_gain") is not None or agrees(model, allowed):
        return model
    return _compare(record, model, allowed, options)[0]


def agrees(model: IdentifiedModel, allowed: FloatArray) -> bool:
    """Return whether the sensor gains of a model are near those that a record allows.

    Gains that were not found have to be among these.
    """
    gains = np.array(model.sensor_gains)
    far = [1.0 if axis.sensor_gain_error is None else _OUTSIDE for axis in model.axes]
    return bool(np.all((gains >= allowed[:, 0] / far) & (gains <= allowed[:, 1] * far)))


def _compare(
    record: LoopRecord, model: IdentifiedModel, allowed: FloatArray, options: dict[str, Any]
) -> tuple[IdentifiedModel, bool]:
    """Return the likeliest of a model and those from allowed gains; whether these are excluded."""
    inside = options | {"sensor_gain": np.sqrt(np.prod(allowed, axis=1)).tolist()}
    held = []
    for start in (None, model):
        with suppress(NumericalError):
            held.append(identify(record, **inside | {"start": start}))
    if not held:
        return model, False
    begun = min(held, key=_criterion)
    best = min(model, identify(record, **options | {"start": begun}), key=_criterion)
    agreed, why = agrees(best, allowed), ""
    if not _are_within(best, POSSIBLE_GAINS):
        why = (
            f"the fit asks for a sensor gain of {_words(best)}, which no sensor has (the "
            "disturbance has something that the model leaves out)"
        )
    elif not agreed and not _are_found(best):
        why = "the fit does not find the sensor gain"
    if why:
        taken = f"{_words(begun)} was taken, from the middle of what the record allows"
        each = zip(begun.axes, best.axes, strict=True)
        axes = tuple(replace(axis, likely_gains=free.likely_gains) for axis, free in each)
        notes = (*begun.notes, f"warning: {why}: {taken}")
        return replace(begun, axes=axes, notes=notes), False
    return best, _criterion(begun) > _criterion(best) + _price(best) and not agreed


def _are_found(model: IdentifiedModel) -> bool:
    return all(axis.sensor_gain_error is not None for axis in model.axes)


def _are_within(model: IdentifiedModel, gains: tuple[float, float]) -> bool:
    return all(gains[0] <= gain <= gains[1] for gain in model.sensor_gains)


def _is_plausible(model: IdentifiedModel) -> bool:
    return _are_found(model) and _are_within(model, PLAUSIBLE_GAINS)


def _words(model: IdentifiedModel) -> str:
    return " and ".join(dict.fromkeys(f"{gain:.3g}" for gain in model.sensor_gains))


def _price(model: IdentifiedModel) -> float:
    """Return what a component must add to the logarithm of the likelihood."""
    return max(Search(data=axis.data).price for axis in model.axes)


def _criterion(model: IdentifiedModel) -> float:
    """Return minus the logarithm of the likelihood plus the price of all components."""
    price = _price(model)
    fits = [axis.fitted_model for axis in model.axes]
    return float(sum(fit.contrast + price * len(fit.spectrum.components) for fit in fits))


def allowed_gains(record: LoopRecord, model: IdentifiedModel | None = None) -> FloatArray:
    """Return the interval of sensor gains of each axis that a closed-loop record allows.

    Parameters
    ----------
    record : LoopRecord
        A closed-loop record with its delay.
    model : IdentifiedModel, optional
        Its resonances are part of the coarse spectrum, which has no wide ones of its own above
        25 Hz and would explain such by a wrong gain.

    Returns
    -------
    (axes, 2) ndarray
        Least and largest gain whose profile likelihood, by a coarse model of the spectrum, is
        within 6 of the best, more where the model misfits, and at which the recorded law is
        stable; 0.08 to 2.5 at most.

    Raises
    ------
    ProblemError
        If the record has no delay.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20.0, frame_rate_hz=500)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=5.0, sensor_gain=0.6)
    >>> path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    >>> run = lbt.simulate(
    ...     lbt.integrator(path, gain=0.4).controller, truth, hardware=path, frames=10_000
    ... )
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> low, high = lbt.identification.allowed_gains(record)[0]
    >>> bool(low < 0.6 < high < 2)
    True
    """
    everything = np.tile([_LEAST, _MOST], (record.axes, 1))
    known = None
    if model is not None:
        to_hz = model.frame_rate_hz / (2 * np.pi)
        each = (axis.fitted_model.spectrum.components for axis in model.axes)
        known = [
            [(c.frequency * to_hz, c.damping_ratio) for c in components] for components in each
        ]
    coarse = CoarseRecord(record, known)
    if not coarse.stretches:
        return everything
    given = CommandRepair()
    contrast, gains, (misfit,) = coarse.compare([given])
    far = np.geomspace(_LEAST, _MOST, _FAR_STEPS)
    grid = np.array([[*far, *(gain * _NEAR)] for gain in gains[:, 0]])
    excess = coarse.profile(given, grid) - contrast
    allowed = excess < _FAR * dispersion(misfit)
    allowed[np.arange(len(grid)), np.argmin(excess, axis=1)] = True
    ends = [(np.min(row[good]), np.max(row[good])) for row, good in zip(grid, allowed, strict=True)]
    low, high = np.array(ends, dtype=np.float64).T
    intervals: FloatArray = np.clip(np.column_stack([low, high]), _LEAST, _MOST)
    law = record_law(record)
    if law is None or law.kind == "none" or law.lag_frames < 0:
        return intervals
    one = np.ones((1, record.axes))
    running = far[[could_have_run(given, gain * one, record, law) for gain in far]]
    if not running.size:
        return intervals
    apart = (intervals[:, :1] > running[-1]) | (intervals[:, 1:] <= running[0])
    inside = np.clip(intervals, running[0], running[-1])
    return np.where(apart, [running[0], running[-1]], inside)


def unstable_gains(design: Design, gains: FloatArray) -> FloatArray | None:
    """Return sensor gains within intervals (axes, 2) at which a design's loop is unstable.

    Each corner of the box is tried, and all common factors on the design's own gains that its
    sides allow: exact for axes that decouple. None if the loop is stable at all of them.
    """
    hardware = design.hardware
    assert hardware is not None
    for corner in product(*gains):
        path = replace(hardware, sensor_matrix=np.diag(corner))
        if not close_loop(path, design.controller).is_stable:
            return np.array(corner)
    own = np.diag(hardware.sensor)
    factors = gains / own[:, None]
    low, high = stable_sensor_gains(hardware, design.controller)
    for factor in (np.min(factors), np.max(factors)):
        if not low < factor < high:
            return np.asarray(factor * own)
    return None


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
        errors = [DIFFERENT * (axis.sensor_gain_error or 0.0) for axis in each.axes]
        found += [own - np.minimum(errors, own / 2), own + errors]
        likely = [axis.likely_gains or 2 * (axis.sensor_gain,) for axis in each.axes]
        found += list(np.transpose(likely))
    return np.column_stack([np.min(found, axis=0), np.max(found, axis=0)])


def design_for_gains(
    fit_model: Callable[..., IdentifiedModel],
    design: Callable[[IdentifiedModel], Design],
    design_robustly: Callable[[IdentifiedModel, tuple[float, float]], Design],
    models: tuple[IdentifiedModel, IdentifiedModel],
    allowed: FloatArray | None,
    *,
    command_scale_known: bool,
) -> tuple[IdentifiedModel, Design, tuple[str, ...]]:
    """Return a design that is stable at all possible gains of two models, for the first of them.

    It comes with its model and with notes; its first assumption says which gains these are.
    Commands that were recorded at half their size look like twice the sensor gain, and no record
    can tell; so half of the gains are possible, unless the scale of the commands is known. Where
    the axes have different gains, the commands of either may have another size than was recorded,
    and each axis may have the gains of both.
    """
    model, _ = models
    made = design(model)
    if allowed is None:
        return model, made, ()
    known = intervals = possible_gains(allowed, *models)
    uneven = max(model.sensor_gains) > _UNEVEN * min(model.sensor_gains)
    assumed = (
        f"the sensor gain lies within {_in_words(known)}, as the record and its model allow; "
        "the loop is stable at all of these"
    )
    if command_scale_known:
        assumed += ". The commands were recorded at the size that was applied, as was stated"
    else:
        intervals = known * [_HALF, 1.0]
        assumed += " and at half of them, should the commands be recorded at half their size"
        if uneven:
            low = np.minimum(intervals[:, 0], known.min())
            intervals = np.column_stack([low, np.full(len(low), known.max())])
            assumed += ", and each axis at those of both, because they differ"
    used, safe, notes = model, made, list[str]()
    if (bad := unstable_gains(made, intervals)) is not None:
        low, high = float(np.min(intervals)), float(np.max(intervals))
        own = float(np.mean(model.sensor_gains))
        tried = [*(own * part for part in _CAREFUL), high / _WIDE, float(np.sqrt(low * high))]
        for gain in [max(model.sensor_gains)] * uneven + tried:
            used = fit_model(start=model, sensor_gain=gain)
            safe = design(used)
            if unstable_gains(safe, intervals) is None:
                break
        else:
            used, safe = model, _robust(model, bad, intervals, design_robustly, command_scale_known)
        note = (
            f"to be stable at sensor gains of {_in_words(intervals)}, the design leaves "
            f"{_residual(safe, model)} in the model; without that it would leave "
            f"{_residual(made, model)}"
        )
        if not command_scale_known and unstable_gains(made, known) is None:
            note += " (--command-scale 1: the commands were recorded at the size that was applied)"
        notes.append(note)
    return used, replace(safe, assumptions=(assumed, *safe.assumptions)), tuple(notes)


def _residual(design: Design, model: IdentifiedModel) -> str:
    """Say what a design leaves in a model; infinite where its loop is unstable."""
    loop = close_loop(model.hardware, design.controller)
    return nm_text(residual_budget(loop, model.truth()).rms_nm if loop.is_stable else np.inf)


def _robust(
    model: IdentifiedModel,
    bad: FloatArray,
    intervals: FloatArray,
    design_robustly: Callable[[IdentifiedModel, tuple[float, float]], Design],
    command_scale_known: bool,
) -> Design:
    """Return a design by robust synthesis, or refuse with the gains that are bad for another."""
    factors = intervals / np.array(model.sensor_gains)[:, None]
    with suppress(SynthesisError, ProblemError):  # a plant without lines has no such design
        made = design_robustly(model, (float(np.min(factors)), float(np.max(factors))))
        if unstable_gains(made, intervals) is None:
            return made
    gain = ", ".join(f"{value:.3g}" for value in bad)
    advice = "" if command_scale_known else ", or say --command-scale 1 (recorded as applied)"
    raise CertificateError(
        f"the loop of the design is unstable at the sensor gain {gain}, and the record allows "
        f"{_in_words(intervals)}. Record with a higher loop gain, look for jumps in the record, "
        f"give the sensor gain{advice}."
    )


def _in_words(intervals: FloatArray) -> str:
    return " and ".join(dict.fromkeys(f"{low:.3g} to {high:.3g}" for low, high in intervals))
