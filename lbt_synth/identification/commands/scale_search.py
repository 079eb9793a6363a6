"""The factor of commands whose sensor gains are implausible, by the coarse model and by the fit."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.commands.command_scale import likely_factors, usual_gain
from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.plausibility import (
    could_have_run,
    finer_saving_of_gain,
    fit_gains,
)
from lbt_synth.validation import FloatArray

_INSIDE = 8  # gains that are tried of the plausible ones


def find_scale(
    coarse: CoarseRecord,
    law: ControlLaw | None,
    guess: Guess,
    found: FloatArray,
    *,
    own_contrast: float,
    clear: float,
    plausible: tuple[float, float],
) -> FloatArray:
    """Return the factors (axes,) of commands that make implausible gains plausible ones.

    ``found`` are the gains (axes,) of a guess, ``own_contrast`` is its contrast there without the
    coherence of the axes, and ``clear`` what decides.
    """
    low, high = plausible
    bounded, nothing = np.clip(found, low, high), np.ones(found.size)
    if np.all(bounded == found):
        return nothing
    inside = np.geomspace(low, high, _INSIDE)
    near = coarse.profile(guess, np.tile(inside, (found.size, 1)))
    if np.sum(np.min(near, axis=1)) - own_contrast < clear:
        return nothing
    gains = fit_gains(coarse, guess, found)
    scale, usual = likely_factors(gains, plausible), usual_gain(plausible)
    gain = float(np.exp(np.mean(np.log(gains))))
    if law is not None and law.is_sure:
        if not could_have_run(guess, inside[:, None] * nothing, coarse.record, law):
            return scale
        if gain < low:  # commands that are too large come from a law that is too strong
            return nothing
    shown = finer_saving_of_gain(coarse, guess, plausible, usual) >= clear
    return scale if shown else nothing
