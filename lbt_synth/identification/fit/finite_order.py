"""Processes of finite order, nearest to a fit whose turbulence falls as tilt does."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial

import numpy as np

from lbt_synth.identification.fit import fitting
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import SpectrumModel
from lbt_synth.identification.fit.whittle import FittedModel, density, minimise
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import FloatArray

_DRIFTS_HZ = (0.3, 1.0, 3.0, 10.0)  # where a resonance in the place of a drift may lie
_DRIFT_DAMPING = 0.8


def nearest_processes(
    search: Search, model: FittedModel, shared: Collection[int] = ()
) -> FittedModel:
    """Return a fit whose turbulence has a finite order, the nearest by its likelihood.

    Turbulence has the third order. Of a drift and turbulence, one has the first place, and the
    other one is a resonance: the turbulence, without its roll-off, or the drift, which then falls
    as a resonance does, where that is clearly nearer. Lines stay as they are, and so do components
    that are ``shared`` with another axis, by their places.
    """
    whole = model.spectrum
    if not whole.rolls_off:
        return model
    places = [i for i, c in enumerate(whole.components) if c.kind != "line"]
    slow = whole.keep(lambda c: c.kind != "line")
    data = search.merge(slow)
    held = density(data, whole.alone(*(line for line in whole.lines if not line.is_narrow)))
    zero = np.zeros_like(held)
    fitted = replace(data, measured=density(data, slow) + held, crossed=zero, corrected=zero)
    nearest = partial(_fit_nearest, search, fitted, held)
    if slow.rolling == "turbulence":
        start = replace(slow, roll_off_order=1.0)
        found = nearest(start, [0])
        return _with_slow(model, start if found is None else found.spectrum)
    moving = [i for i, place in enumerate(places) if place not in shared]
    kept = nearest(slow.without_roll_off(), moving)
    turbulence = [i for i in moving if i > 0]
    best = None
    if turbulence:
        place = slow.strongest(turbulence)
        starts = [_exchange_drift(search, slow, place, hz) for hz in _DRIFTS_HZ]
        best = fitting.likeliest(search, [nearest(start, moving) for start in starts])
    if best is None or (kept is not None and kept.contrast < best.contrast + search.price):
        return _with_slow(model, slow.without_roll_off() if kept is None else kept.spectrum)
    return _with_slow(_exchange_errors(model, places[place]), best.spectrum)


def _with_slow(model: FittedModel, slow: SpectrumModel) -> FittedModel:
    """Return a fit with other components in the places of those that are no lines."""
    others, whole = iter(slow.components), model.spectrum.components
    components = tuple(c if c.kind == "line" else next(others) for c in whole)
    return replace(model, spectrum=replace(slow, components=components))


def _exchange_drift(
    search: Search, slow: SpectrumModel, place: int, frequency_hz: float
) -> SpectrumModel:
    """Return a model with turbulence of finite order before a drift, which is a resonance."""
    drift = search.component("slow", frequency_hz, _DRIFT_DAMPING, 1.0)
    drift = replace(drift, log_power=slow.components[0].log_power)
    return replace(slow.promote(place, drift), roll_off_order=1.0)


def _exchange_errors(model: FittedModel, place: int) -> FittedModel:
    """Return a fit with the information on its first component and another one exchanged."""
    order = np.arange(len(model.information))
    blocks = order[-PARAMETERS * len(model.spectrum.components) :].reshape(-1, PARAMETERS)
    blocks[[0, place]] = blocks[[place, 0]]
    return replace(model, information=model.information[np.ix_(order, order)])


def _fit_nearest(
    search: Search,
    fitted: LoopPeriodogram,
    held: FloatArray,
    start: SpectrumModel,
    moving: Collection[int],
) -> FittedModel | None:
    """Fit the components in some places, and the roll-off, to a spectrum at its gain and noise."""
    priors = search.priors(start)
    moves = np.repeat([i in moving for i in range(len(start.components))], PARAMETERS)
    first = np.zeros(priors.width.size - moves.size, dtype=np.bool_)
    first[-1] = start.rolls_off
    width = np.where(np.append(first, moves), priors.width, 0)
    return minimise(fitted, start, replace(priors, width=width), held=held)
