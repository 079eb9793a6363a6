"""Processes of finite order, nearest to a fit whose turbulence falls as tilt does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.identification.fit import fitting
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import Kind, SpectrumModel, damping_parameter
from lbt_synth.identification.fit.whittle import FittedModel, densities, minimise
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import BoolArray

_DRIFTS_HZ = (0.3, 1.0, 3.0, 10.0)  # where a resonance in the place of a drift may lie
_DRIFT_DAMPING = 0.8


def nearest_processes(search: Search, model: FittedModel) -> FittedModel:
    """Return a fit whose turbulence has a finite order, the nearest by its likelihood.

    Turbulence has the third order. Of a drift and turbulence, one has the first place, and the
    other one is a resonance: either the turbulence, without its roll-off, or the drift, which then
    falls as a resonance does.
    """
    spectrum = model.spectrum
    if not spectrum.rolls_off:
        return model
    data = search.merge(spectrum)
    fitted, zero = densities(data, spectrum)[0].sum(axis=0), np.zeros_like(data.measured)
    data = replace(data, measured=fitted, crossed=zero, corrected=zero)
    if spectrum.rolling == "turbulence":
        start = replace(spectrum, roll_off_order=1.0)
        found = _fit_nearest(search, data, start, "turbulence")
        return replace(model, spectrum=start if found is None else found.spectrum)
    start = spectrum.without_roll_off()
    best = _fit_nearest(search, data, start, "drift", "slow")
    exchanged, place = _exchange_drift(search, model)
    for hz in _DRIFTS_HZ:
        begin = exchanged.spectrum.components[place]
        begin = replace(begin, log_frequency=search.log_angle(hz))
        trial = exchanged.spectrum.exchange(place, begin)
        found = _fit_nearest(search, data, trial, "turbulence", "slow")
        best = fitting.likeliest(search, [best, found])
    if best is None:
        return replace(model, spectrum=start)
    made = model if best.spectrum.rolling == "slow" else exchanged
    return replace(made, spectrum=best.spectrum)


def _exchange_drift(search: Search, model: FittedModel) -> tuple[FittedModel, int]:
    """Return a fit with its turbulence in the first place, and where the drift is now."""
    spectrum = model.spectrum
    slow = [i for i, c in enumerate(spectrum.components) if c.kind == "slow"]
    place = spectrum.strongest(slow)
    damping = damping_parameter("slow", _DRIFT_DAMPING)
    drift = replace(spectrum.components[0], kind="slow", damping=damping)
    order = np.arange(spectrum.pack().size)
    blocks = order[-PARAMETERS * len(spectrum.components) :].reshape(-1, PARAMETERS)
    blocks[[0, place]] = blocks[[place, 0]]
    information = model.information[np.ix_(order, order)]
    moved = replace(spectrum.promote(place, drift), roll_off_order=1.0)
    return replace(model, spectrum=moved, information=information), place


def _fit_nearest(
    search: Search, data: LoopPeriodogram, start: SpectrumModel, *kinds: Kind
) -> FittedModel | None:
    """Fit components of some kinds, and the roll-off, to a spectrum."""
    priors = search.priors(start)
    width = np.where(_belong(start, kinds), priors.width, 0)
    return minimise(data, start, replace(priors, width=width))


def _belong(spectrum: SpectrumModel, kinds: tuple[Kind, ...]) -> BoolArray:
    """Return which parameters are those of components of some kinds, and of the roll-off (p,)."""
    own = np.repeat([c.kind in kinds for c in spectrum.components], PARAMETERS)
    first = np.zeros(spectrum.pack().size - own.size, dtype=np.bool_)
    first[-1] = spectrum.rolls_off
    return np.append(first, own)
