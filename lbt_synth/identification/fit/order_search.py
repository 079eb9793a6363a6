"""The search for the resonances of a spectrum, and for their number.

The model grows from a background, turbulence over white noise: bands with too much power
become components, all parameters are fitted together, and whatever adds less to the logarithm
of the likelihood than a penalised criterion asks is dropped again. For a line of three
parameters among n values the Bayesian information criterion asks ``3 / 2 log n`` (G. Schwarz,
Ann. Statist. 6, 461 (1978), doi:10.1214/aos/1176344136).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.identification.fit.fitting import (
    STARTING_CORNER_HZ,
    Search,
    add_evidence,
    centre_line,
    cost,
    drop_roll_off,
    fit,
    likeliest,
    prune,
    refit,
)
from lbt_synth.identification.fit.line_candidates import (
    Candidate,
    find_candidates,
    measure_excess,
    smooth_background,
)
from lbt_synth.identification.fit.parameters import Kind, SpectrumModel
from lbt_synth.identification.fit.whittle import FittedModel, density, minimise

_STARTING_GAINS = (0.35, 0.6, 1.0)
_STARTING_FREQUENCIES_HZ = (0.5, 5.0)  # of the turbulence
_STARTING_DAMPING = 0.55
_FEW_ROUNDS = 3
_MOST_ROUNDS = 12
_HALF = float(np.log(0.5))
_SAME_GAIN = 0.15  # of a logarithm
_MOST_TURBULENCES = 3


def search_model(search: Search, start: SpectrumModel | None = None) -> FittedModel:
    """Find the model of one axis."""
    return add_evidence(search, _find_components(search, start))


def gain_ambiguity(search: Search, best: FittedModel) -> float:
    """Return how far the gain of another, nearly as likely model is, as a logarithm.

    Wide resonances can stand for what a wrong gain leaves. Models are searched for at other
    gains, which are then set free.
    """
    least, gain = cost(search, best), best.spectrum.log_gain
    away = 0.0
    for trial in _STARTING_GAINS:
        if abs(float(np.log(trial)) - gain) < _SAME_GAIN:
            continue
        try:
            other = _find_components(replace(search, gain=trial), None, rounds=_FEW_ROUNDS)
        except NumericalError:
            continue
        made = fit(search, other.spectrum)
        if made is not None and cost(search, made) < least + search.price:
            away = max(away, abs(made.spectrum.log_gain - gain))
    return away


def _find_components(
    search: Search, start: SpectrumModel | None, *, rounds: int = _MOST_ROUNDS
) -> FittedModel:
    """Find the model: add components, move them, prune them."""
    model = None if start is None else refit(search, start)
    if model is None:
        gains = _STARTING_GAINS if search.finds_gain else (search.gain or 1.0,)
        model = likeliest(_begin(search, gain) for gain in gains)
    if model is None:
        raise NumericalError(
            "the likelihood of the spectrum is not finite. Check the units of the series."
        )
    model = _add_announced(search, prune(search, model))
    for _ in range(rounds):
        better = _extend(search, model) or _move_line(search, model)
        if better is None:
            break
        model = better
    return _restore_turbulence(search, prune(search, drop_roll_off(search, model)))


def _begin(search: Search, gain: float) -> FittedModel | None:
    """Fit the background and the first lines at a sensor gain."""
    ground = _fit_background(search, gain)
    if ground is None:
        return None
    found = _find_excesses(search, ground.spectrum)
    clear = [c for c in found if c.gain > max(2 * search.price, 0.02 * found[0].gain)]
    return fit(search, _add_candidates(search, ground.spectrum, clear))


def _fit_background(search: Search, gain: float) -> FittedModel | None:
    """Fit turbulence and noise to medians over bands, which lines hardly touch."""
    data = search.data
    f, d, weight = smooth_background(data.power(gain), data.frequency_hz, data.count)
    zero = np.zeros_like(f)
    smooth = replace(data, frequency_hz=f, measured=d, crossed=zero, corrected=zero, count=weight)
    white = float(np.median(d[f >= 0.6 * f[-1]])) * data.frame_rate_hz / 2
    slow = max(float(np.trapezoid(d, f)) - white, 0.1 * white)
    known = replace(search, gain=gain)
    ground = SpectrumModel(
        float(np.log(gain)), float(np.log(white)), known.log_angle(STARTING_CORNER_HZ), ()
    )
    starts = [
        ground.add(known.component("turbulence", hz, _STARTING_DAMPING, slow))
        for hz in _STARTING_FREQUENCIES_HZ
    ]
    return likeliest(minimise(smooth, start, known.priors(start)) for start in starts)


def _add_candidates(
    search: Search, spectrum: SpectrumModel, found: list[Candidate]
) -> SpectrumModel:
    """Return the model with candidates as components."""
    whole = spectrum
    for c in found:
        line = c.frequency_hz >= search.lowest_line_hz
        ratio = np.clip(c.half_width_hz / c.frequency_hz, 1e-4, 0.3) if line else 0.3
        kind: Kind = "line" if line else "slow"
        whole = whole.add(search.component(kind, c.frequency_hz, ratio, c.variance_nm2))
    for i in range(len(spectrum.components), len(whole.components)):
        whole = centre_line(search, whole, i)
    return whole


def _add_announced(search: Search, model: FittedModel) -> FittedModel:
    """Return the model with those announced lines that add enough.

    A line of the model within three errors of an announced one is taken for it.
    """
    if not search.announced:
        return model
    step, spectrum = search.data.step_hz, model.spectrum
    seen = density(search.data, spectrum)
    for f, error in search.announced:
        known = (search.log_angle(f), max(error, 0.1 * step) / f)
        near = [
            (i, c)
            for i, c in enumerate(model.spectrum.components)
            if c.kind == "line" and abs(search.place(c)[0] - f) < 3 * max(error, step)
        ]
        if near:
            i, line = near[0]
            spectrum = spectrum.exchange(i, replace(line, announced=known))
        else:
            level = float(np.interp(f, search.data.frequency_hz, seen))
            line = search.component("line", f, 0.01, level * max(0.01 * f, step))
            spectrum = spectrum.add(replace(line, announced=known))
    made = fit(search, spectrum)
    return model if made is None else prune(search, made)


def _find_excesses(search: Search, spectrum: SpectrumModel) -> list[Candidate]:
    """Find bands with too much power, as many as there may be more lines."""
    room = search.most_lines - len(spectrum.lines)
    if room <= 0:
        return []
    data = search.data
    power, model = data.power(spectrum.gain), density(data, spectrum)
    found = find_candidates(data, power, model, least=search.price, most=room)
    if len(spectrum.components) - len(spectrum.lines) >= _MOST_TURBULENCES:
        found = [c for c in found if c.frequency_hz >= search.lowest_line_hz]
    return found


def _extend(search: Search, model: FittedModel) -> FittedModel | None:
    """Return the model with the best candidates, those that pay; None if none does."""
    found = _find_excesses(search, model.spectrum)
    found = [c for c in found if c.gain > 0.25 * found[0].gain]
    while found:
        better = _improve(search, model, _add_candidates(search, model.spectrum, found), 0)
        if better is not None:
            return better
        found = found[: len(found) // 2]
    return None


def _move_line(search: Search, model: FittedModel) -> FittedModel | None:
    """Return the model with a line moved, or split in two; None if none is better."""
    for i, component in enumerate(model.spectrum.components):
        for trial in _line_moves(search, model.spectrum, i) if component.kind == "line" else ():
            better = _improve(search, model, trial, 1)
            if better is not None:
                return better
    return None


def _improve(
    search: Search, model: FittedModel, trial: SpectrumModel, least: float
) -> FittedModel | None:
    """Fit and prune a model; None if it costs not less than another by more than ``least``."""
    made = fit(search, trial)
    if made is None:
        return None
    made = prune(search, made)
    return made if cost(search, made) < cost(search, model) - least else None


def _line_moves(search: Search, spectrum: SpectrumModel, i: int) -> Iterator[SpectrumModel]:
    """Yield other beginnings for a line: elsewhere in its band, or as two lines."""
    data, line, step = search.data, spectrum.components[i], search.data.step_hz
    centre, half = search.place(line)
    centred = centre_line(search, spectrum, i)
    moved_by = centred.components[i].log_frequency - line.log_frequency
    if abs(moved_by) * centre > 0.4 * step:
        yield centred
    reach = max(10 * half, 20 * step)
    start, stop = np.searchsorted(data.frequency_hz, [centre - reach, centre + reach])
    rest = density(data, spectrum.exchange(i))
    seen = measure_excess(data, data.power(spectrum.gain), rest, int(start), int(stop))
    if abs(seen.frequency_hz - centre) > 0.5 * half + step:
        ratio = min(seen.half_width_hz / seen.frequency_hz, 0.5)
        again = search.component("line", seen.frequency_hz, ratio, seen.variance_nm2)
        yield spectrum.exchange(i, replace(again, announced=line.announced))
    if half > 3 * step and len(spectrum.lines) < search.most_lines:
        lower, upper = (
            line.shift(float(np.log(1 + side * half / centre)), _HALF, _HALF) for side in (-1, 1)
        )
        yield spectrum.exchange(i, lower).add(replace(upper, announced=None))


def _restore_turbulence(search: Search, model: FittedModel) -> FittedModel:
    """Make a slow component the turbulence, where a resonance took its place."""
    spectrum, lowest = model.spectrum, search.lowest_line_hz * search.data.angle_s
    first, *others = spectrum.components
    slow = [i for i, c in enumerate(others, 1) if c.frequency < lowest]
    if first.frequency < lowest or not slow or spectrum.rolls_off or first.damping_ratio > 0.98:
        return model
    made = fit(search, spectrum.promote(spectrum.strongest(slow), first.convert("line")))
    if made is not None and cost(search, made) < cost(search, model) + search.price:
        return made
    return model
