"""The model of a record at the likeliest sensor gain, and the gains that record and model allow."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.identification.commands.doubts import STEPPED, rounding_share
from lbt_synth.identification.commands.gain_interval import POSSIBLE_GAINS, allowed_gains
from lbt_synth.identification.fit.both_axes import identify
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS, Search
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.validation import FloatArray

_OUTSIDE = 1.3  # factor beyond an interval of gains


def identify_with_gains(
    record: LoopRecord, **options: Any
) -> tuple[IdentifiedModel, FloatArray | None]:
    """Identify a record; return the model and the sensor gains that it allows, (axes, 2).

    None for an open loop, or a gain that is given. Where the coarse spectrum asks for other gains
    than the fit, and a fit that is held at these is clearly less likely, the fit decides: but not
    where the commands are recorded in steps, which move the gain of the fit more, nor where its
    own gain is implausible. A gain that no sensor has, or that was not found, gives way to the
    middle of those that the record allows; where these are implausible, to all plausible ones.
    ``options`` are those of :func:`identify`.
    """
    model = identify(record, **options)
    if record.commands is None or options.get("sensor_gain") is not None:
        return model, None
    allowed = allowed_gains(record, model)
    if not (agrees(model, allowed) or _is_plausible(model)):
        allowed = _with_plausible_gains(allowed)
    if agrees(model, allowed):
        return model, allowed
    best, excluded = _compare(record, model, allowed, options)
    stepped = np.max(rounding_share(record)) > STEPPED
    excluded = excluded and not stepped and _is_plausible(best)
    own = np.repeat(np.array(best.sensor_gains)[:, None], 2, axis=1)
    return best, own if excluded else allowed


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
    near = (gains >= allowed[:, 0] / far) & (gains <= allowed[:, 1] * far)
    return bool(near.all())


def _with_plausible_gains(allowed: FloatArray) -> FloatArray:
    """Return intervals of gains (axes, 2), widened to the plausible ones where they have none."""
    low, high = PLAUSIBLE_GAINS
    odd = (allowed[:, :1] > high) | (allowed[:, 1:] < low)
    wider = np.column_stack([np.minimum(allowed[:, 0], low), np.maximum(allowed[:, 1], high)])
    return np.where(odd, wider, allowed)


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
    if why := _distrust(best, allowed):
        taken = f"{_words(begun)} was taken, from the middle of what the record allows"
        each = zip(begun.axes, best.axes, strict=True)
        axes = tuple(replace(axis, likely_gains=free.likely_gains) for axis, free in each)
        notes = (*begun.notes, f"warning: {why}: {taken}")
        return replace(begun, axes=axes, notes=notes), False
    excluded = _criterion(begun) > _criterion(best) + _price(best)
    return best, excluded and not agrees(best, allowed)


def _are_found(model: IdentifiedModel) -> bool:
    return all(axis.sensor_gain_error is not None for axis in model.axes)


def _is_plausible(model: IdentifiedModel) -> bool:
    return _are_found(model) and _are_within(model, PLAUSIBLE_GAINS)


def _are_within(model: IdentifiedModel, gains: tuple[float, float]) -> bool:
    return all(gains[0] <= gain <= gains[1] for gain in model.sensor_gains)


def _distrust(model: IdentifiedModel, allowed: FloatArray) -> str | None:
    """Return why the gains of a fit are not used, in words."""
    if not _are_within(model, POSSIBLE_GAINS):
        return (
            f"the fit asks for a sensor gain of {_words(model)}, which no sensor has (the "
            "disturbance has something that the model leaves out)"
        )
    if not agrees(model, allowed) and not _are_found(model):
        return "the fit does not find the sensor gain"
    return None


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
