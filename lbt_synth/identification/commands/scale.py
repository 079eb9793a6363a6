"""The factor of commands whose sensor gains are implausible, by the coarse model and by the fit."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.plausibility import (
    could_have_run,
    finer_saving_of_gain,
    fit_gains,
)
from lbt_synth.validation import FloatArray

_FACTORS = (*(10.0**n for n in range(-12, 13) if n), 0.5, 2.0)  # between units, or of reflection
_USUAL_GAIN = 0.7
_COARSE = 1.5  # factor by which a coarse gain may be wrong
_APART = 1.6  # between gains of two axes that have scales of their own
_INSIDE = 8  # gains that are tried of the plausible ones


def find_scale(
    coarse: CoarseRecord,
    law: ControlLaw | None,
    guess: Guess,
    found: FloatArray,
    *,
    contrast: float,
    clear: float,
    plausible: tuple[float, float],
) -> FloatArray:
    """Return the factors (axes,) of commands that make implausible gains plausible ones.

    ``found`` are the gains (axes,) of a guess, ``contrast`` is its contrast there, and ``clear``
    what decides.
    """
    low, high = plausible
    bounded, nothing = np.clip(found, low, high), np.ones(found.size)
    if np.all(bounded == found):
        return nothing
    inside = np.geomspace(low, high, _INSIDE)
    near = coarse.profile(guess, np.tile(inside, (found.size, 1)))
    if np.sum(np.min(near, axis=1)) - contrast < clear:
        return nothing
    gains = fit_gains(coarse, guess, found)
    scale, usual = likely_factors(gains, plausible), _usual_gain(plausible)
    gain = float(np.exp(np.mean(np.log(gains))))
    if law is not None and law.is_sure:
        if not could_have_run(guess, inside[:, None] * nothing, coarse.record, law):
            return scale
        if gain < low:  # commands that are too large come from a law that is too strong
            return nothing
    shown = finer_saving_of_gain(coarse, guess, plausible, usual) >= clear
    return scale if shown else nothing


def _usual_gain(plausible: tuple[float, float]) -> float:
    """Return the gain that a sensor has most often."""
    return float(np.clip(_USUAL_GAIN, *plausible))


def likely_factors(gains: FloatArray, plausible: tuple[float, float]) -> FloatArray:
    """Return the likeliest factor of the commands of each axis with these gains, (axes,)."""
    low, high = plausible
    if np.max(gains) < _APART * np.min(gains):
        together = float(np.exp(np.mean(np.log(gains))))
        return np.full(gains.size, _likely_factor(together, plausible))
    each = [1.0 if low <= gain <= high else _likely_factor(gain, plausible) for gain in gains]
    return np.array(each)


def _likely_factor(gain: float, plausible: tuple[float, float]) -> float:
    """Return the likeliest factor of commands with a gain."""
    low, high = plausible
    usual = _usual_gain(plausible)
    fits = [f for f in _FACTORS if low <= gain / f <= high]
    fits = fits or [f for f in _FACTORS if low / _COARSE <= gain / f <= _COARSE * high]
    if fits:
        return float(min(fits, key=lambda f: abs(np.log(gain / f / usual))))
    return float(f"{gain / usual:.2g}")


def wrong_scale(scale: FloatArray, gain: FloatArray) -> str:
    """Return the words for commands that need a factor on each axis, (axes,)."""
    sizes = [
        f"{1 / factor:g} times too large" if factor < 1 else f"{factor:g} times too small"
        for factor in scale
    ]
    words = f"they are {sizes[0]}"
    if np.ptp(scale):
        each = zip(sizes, scale, strict=True)
        words = " and ".join(
            f"those of axis {i} are {size}" for i, (size, factor) in enumerate(each) if factor != 1
        )
    gains = ", ".join(f"{value:.3g}" for value in gain)
    return f"{words} (with them the sensor has a gain of {gains})"
