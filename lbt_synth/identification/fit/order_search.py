"""The search for the resonances of a spectrum, and for their number.

The model grows from a background, turbulence over white noise, fitted to medians over bands, which
narrow lines hardly touch. Bands with too much power become components, all parameters are fitted
together, and what adds less to the logarithm of the likelihood than a criterion asks is dropped
again: the Bayesian one asks ``3 / 2 log n`` for a line of three parameters among n values
(G. Schwarz, Ann. Statist. 6, 461 (1978), doi:10.1214/aos/1176344136).

Bands in which a spectrum has more power than its model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.identification.fit import fitting
from lbt_synth.identification.fit.fitting import GAINS, Search
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.scoring import SEARCHED
from lbt_synth.identification.fit.spectrum_model import Component, SpectrumModel
from lbt_synth.identification.fit.whittle import FittedModel, contrast, density, minimise
from lbt_synth.validation import FloatArray

FEW_ROUNDS = 3
_LITTLE, _CLEARLY = 0.1, 1.0  # log-likelihood that a component or a move must save at least
_MOST_ROUNDS = 12
_HALF = float(np.log(0.5))
_SAME_GAIN = 0.15  # of a logarithm
_MOST_TURBULENCES = 3
_SIGNIFICANT = 1.92  # log-likelihood that one parameter too many adds in 5 % of the cases
_BEYOND = 0.2  # of a logarithm: standard deviation of gains beyond the plausible ones
_FAR_GAIN = 3.0  # standard errors by which a colour of the noise moves a gain that is doubted
_SAME_NOISE = 0.1  # of the correlation of neighbouring frames
_OTHER_NOISE = 5.0  # log-likelihood by which noise of another correlation is excluded
_COLOUR = 0.3  # of the noise, where a fit begins
_MOST_COLOUR = float(np.arctanh(0.8))  # beyond, it is a drift, no white noise for a design
_TURBULENCE = ((0.5, 0.55), (5.0, 0.55))  # frequency [Hz] and damping ratio where a fit begins
_NEARLY_FIRST_ORDER = 2.0  # damping ratio from which turbulence may be a drift
_OVERDAMPED = (2.0, 30.0)  # the same of turbulence that is nearly of first order
_CROSSINGS_HZ = (1.0, 3.0, 10.0, 30.0, 100.0)  # where a drift beside turbulence may meet the noise
_SHARES = (1.0, 0.1)  # of the slow variance in that turbulence
_MOST_DRIFTS = 2  # fits of both
_BANDS = 80
_GAINS = (2 * GAINS["above"], GAINS["below"] / 2)
_WIDEST = 0.3  # of its frequency: a band that is tried, and the damping ratio of a new component
_NARROWEST = 1e-4  # damping ratio of a new component

Excess = tuple[float, Component]  # what it would add to the log-likelihood, and a component


def search_models(search: Search, start: SpectrumModel | None = None) -> list[FittedModel]:
    """Find the model of one axis, and its rivals with noise that is not white.

    A start has been found in earlier data: there is little left to find. A rival is searched for
    further where it may explain wide components or a wrong gain.
    """
    model = find_components(search, start)
    models, spectrum = [model], model.spectrum
    coloured = fitting.fit(search, replace(spectrum, colour=_COLOUR))
    if coloured is not None and not spectrum.colour:
        plain = start is not None or all(c.is_narrow for c in spectrum.components[1:])
        models.append(coloured)
        if not plain or fitting.cost(search, coloured) < fitting.cost(search, model):
            models.append(find_components(search, coloured.spectrum))
        models.sort(key=lambda trial: _cost_of_noise(search, trial))
    return [fitting.add_evidence(search, models[0]), *models[1:]]


def is_coloured_rival(model: FittedModel, rival: FittedModel, gain_error: float) -> bool:
    """Whether a model of coloured noise is likelier than one of white noise, and its gain far away.

    Sensors and filters make neighbouring frames alike, hardly ever opposite.
    """
    own, other = model.spectrum, rival.spectrum
    is_far = abs(other.log_gain - own.log_gain) > _FAR_GAIN * gain_error
    is_likelier = model.contrast - rival.contrast >= _SIGNIFICANT
    return not own.colour and 0 < other.colour < _MOST_COLOUR and is_likelier and is_far


def _cost_of_noise(search: Search, model: FittedModel) -> float:
    """Return the cost of a model in which a colour of the noise competes with wide resonances.

    A wide resonance fits most spectra that fall, and counts twice.
    """
    spectrum = model.spectrum
    wide = sum(not c.is_narrow for c in spectrum.lines)
    return _cost_with_gain(search, model) + search.price * wide


def _cost_with_gain(search: Search, model: FittedModel) -> float:
    """Return the cost of a model whose gain may be one that hardly any sensor has.

    At a gain of almost nothing, what the loop left needs a simpler spectrum than the disturbance.
    """
    gain = model.spectrum.gain
    beyond = float(np.log(gain / np.clip(gain, *fitting.PLAUSIBLE_GAINS)))
    return fitting.cost(search, model) + 0.5 * (beyond / _BEYOND) ** 2 * search.finds_gain


def try_other_gains(
    search: Search, model: FittedModel, rivals: Sequence[FittedModel] = ()
) -> tuple[FittedModel, list[FittedModel]]:
    """Return the likeliest model from several gains, and all models of nearly its cost, itself too.

    Wide resonances, or a colour of the noise, can explain what a wrong gain leaves; the places of
    lines cannot.
    """
    spectrum, found = model.spectrum, [model, *rivals]
    for gain, colour in product(search.starting_gains, sorted({spectrum.colour, 0.0})):
        if colour == spectrum.colour and abs(np.log(gain) - spectrum.log_gain) < _SAME_GAIN:
            continue
        begin = replace(search, gain=gain)
        try:
            known = replace(spectrum, colour=colour)
            held = find_components(begin, known, moves=False)
        except NumericalError:
            continue
        free = fitting.fit(search, held.spectrum)
        if free is not None and abs(free.spectrum.colour) < _MOST_COLOUR:
            found.append(free)
    best = min(found, key=lambda each: _cost_of_noise(search, each))
    near, costs = [], (_cost_with_gain, _cost_of_noise)
    least = [cost(search, best) for cost in costs]
    for each in found:
        colour, own = each.spectrum.colour, best.spectrum.colour
        same = bool(colour) == bool(own) and abs(np.tanh(colour) - np.tanh(own)) < _SAME_NOISE
        above = min(cost(search, each) - low for cost, low in zip(costs, least, strict=True))
        if above < (search.price if same else _OTHER_NOISE):
            near.append(each)
    if best is not model:
        best = fitting.add_evidence(search, fitting.prune(search, best, thorough=True))
    return best, near


def find_components(
    search: Search,
    start: SpectrumModel | None = None,
    *,
    rounds: int | None = None,
    moves: bool = True,
) -> FittedModel:
    """Find the model: add components, prune them, and move lines (with ``moves``).

    One that starts from an earlier model has few rounds.
    """
    model = None if start is None else fitting.refit(search, start)
    if model is None:
        model = _begin(search)
    if model is None:
        raise NumericalError(
            "the likelihood of the spectrum is not finite. Check the units of the series."
        )
    model = _add_announced(search, fitting.prune(search, model))
    if rounds is None:
        rounds = _MOST_ROUNDS if start is None else FEW_ROUNDS
    for _ in range(rounds):
        better = _improve(search, model, moves)
        if better is None:
            break
        model = better
    if abs(model.spectrum.colour) > _MOST_COLOUR:
        white = None if start is None else start.without_colour()
        return find_components(search, white, rounds=rounds, moves=moves)
    model = fitting.prune(search, fitting.simplify(search, model), thorough=moves)
    return _restore_turbulence(search, model)


def _improve(search: Search, model: FittedModel, moves: bool) -> FittedModel | None:
    """Return the best of the first trials of which one is clearly better; None if none is."""
    for trials, least in _trials(search, model.spectrum, moves):
        fits = (fitting.fit(search, trial, better_than=model) for trial in trials)
        pruned = [fitting.prune(search, made) for made in fits if made is not None]
        best = fitting.likeliest(search, pruned)
        if best is not None and fitting.cost(search, best) < fitting.cost(search, model) - least:
            return best
    return None


def _trials(
    search: Search, spectrum: SpectrumModel, moves: bool
) -> Iterator[tuple[list[SpectrumModel], float]]:
    """Yield models with other turbulence, new lines or other places, and what they must save."""
    first, *others = spectrum.components
    lines = [c for c in others if c.kind == "line"]
    has_parts = len(lines) < len(others)
    nearly_first_order = first.kind == "drift" or first.damping_ratio > _NEARLY_FIRST_ORDER
    # where no line can be added, a second turbulence would take the place of one
    room = len(lines) < search.most_lines
    found = find_excesses(search, spectrum)
    found = [excess for excess in found if excess[0] > 0.25 * found[0][0]]
    either = [_add_centred(search, spectrum, found)] if found else []
    if room and not nearly_first_order:
        either += _other_backgrounds(search, spectrum, lines, drifts=True)
    yield either, _LITTLE
    while found := found[: len(found) // 2]:
        yield [_add_centred(search, spectrum, found)], _LITTLE
    for i, component in enumerate(spectrum.components):
        if moves and component.kind == "line":
            yield from (([trial], _CLEARLY) for trial in _line_moves(search, spectrum, i))
    if room and nearly_first_order and not (has_parts and first.kind == "drift"):
        yield _other_backgrounds(search, spectrum, lines, drifts=True), _LITTLE
    if has_parts:
        yield _other_backgrounds(search, spectrum, lines, drifts=False), _LITTLE


def _other_backgrounds(
    search: Search, spectrum: SpectrumModel, lines: Sequence[Component], *, drifts: bool
) -> list[SpectrumModel]:
    """Return the model with turbulence fitted afresh beside its lines."""
    ground = fit_background(search, spectrum.gain, lines, drifts=drifts, colour=spectrum.colour)
    return [] if ground is None else [ground.spectrum.add(*lines)]


def _begin(search: Search) -> FittedModel | None:
    """Fit the background and the clear lines.

    The gain is held until the lines and a drift are there: one that is free while these are missing
    runs away to what explains them.
    """
    known = search if not search.finds_gain else replace(search, gain=search.starting_gains[0])
    model = fit_background(known, known.gain or 1.0)
    for _ in range(FEW_ROUNDS):
        found = [] if model is None else find_excesses(known, model.spectrum)
        clear = [one for one in found if one[0] > max(2 * search.price, 0.02 * found[0][0])]
        if model is None or not clear:
            break
        model = fitting.fit(known, _add_centred(known, model.spectrum, clear))
    if model is None or not search.finds_gain:
        return model
    trials = _other_backgrounds(known, model.spectrum, model.spectrum.lines, drifts=True)
    drifting = (fitting.fit(known, trial, better_than=model) for trial in trials)
    model = fitting.likeliest(known, [model, *drifting]) or model
    return fitting.fit(search, model.spectrum)


def _add_centred(search: Search, spectrum: SpectrumModel, new: list[Excess]) -> SpectrumModel:
    """Return the model with more components, each where it fits best."""
    whole = spectrum.add(*(component for _, component in new))
    for i in range(len(spectrum.components), len(whole.components)):
        whole = fitting.centre_line(search, whole, i)
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
        level = float(np.interp(f, search.data.frequency_hz, seen))
        line = search.component("line", f, 0.01, level * max(0.01 * f, step))
        place = len(spectrum.components)
        for i, c in enumerate(model.spectrum.components):
            if c.kind == "line" and abs(search.place(c)[0] - f) < 3 * max(error, step):
                place, line = i, spectrum.components[i]
                break
        spectrum = spectrum.exchange(place, replace(line, announced=known))
    made = fitting.fit(search, spectrum)
    return model if made is None else fitting.prune(search, made)


def find_excesses(search: Search, spectrum: SpectrumModel) -> list[Excess]:
    """Find components where a model lacks power, as many as there may be more lines."""
    room = search.most_lines - len(spectrum.lines)
    if room <= 0:
        return []
    data = search.data
    power, model = data.power(spectrum.gain), density(data, spectrum)
    out = []
    for worth, *ends in _excess_bands(data, power / model, least=search.price, most=room):
        component = _highest_excess(search, power, model, slice(*ends), _WIDEST)
        if search.place(component)[0] < search.lowest_line_hz:
            slow = search.component("slow", search.place(component)[0], _WIDEST, 1.0)
            component = replace(slow, log_power=component.log_power)
        out.append((worth, component))
    if len(spectrum.components) - len(spectrum.lines) >= _MOST_TURBULENCES:
        out = [(worth, component) for worth, component in out if component.kind == "line"]
    return out


def _line_moves(search: Search, spectrum: SpectrumModel, i: int) -> Iterator[SpectrumModel]:
    """Yield other beginnings for a line: elsewhere in its band, or as two lines."""
    data, line, step = search.data, spectrum.components[i], search.data.step_hz
    centre, half = search.place(line)
    centred = fitting.centre_line(search, spectrum, i)
    moved_by = centred.components[i].log_frequency - line.log_frequency
    if abs(moved_by) * centre > 0.4 * step:
        yield centred
    reach = max(10 * half, 20 * step)
    lowest = min(max(centre - reach, search.lowest_line_hz), centre)
    start, stop = np.searchsorted(data.frequency_hz, [lowest, centre + reach])
    rest = density(data, spectrum.exchange(i))
    band = slice(int(start), int(stop))
    again = _highest_excess(search, data.power(spectrum.gain), rest, band, 0.5)
    if abs(search.place(again)[0] - centre) > 0.5 * half + step:
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
    made = fitting.fit(search, spectrum.promote(spectrum.strongest(slow), first.convert("line")))
    if made is not None and fitting.cost(search, made) < fitting.cost(search, model) + search.price:
        return made
    return model


def fit_background(
    search: Search,
    gain: float,
    lines: Sequence[Component] = (),
    *,
    drifts: bool = False,
    colour: float = 0.0,
) -> FittedModel | None:
    """Fit turbulence and noise beside lines at a sensor gain; None if no fit settles.

    A gain that a free fit ran away to counts as the nearest that a sensor may have.
    Second-order processes cannot fall with the square of the frequency, and lines would fill the
    gap. With ``drifts``, a first-order process comes first, and the turbulence is a part beside it.
    """
    gain = float(np.clip(gain, *_GAINS))
    smooth = _smooth_background(search.data, gain)
    f, d, rate = smooth.frequency_hz, smooth.measured, smooth.frame_rate_hz
    white = max(float(np.median(d[f >= 0.6 * f[-1]])) * rate / 2, float(np.finfo(float).tiny))
    known = replace(search, gain=gain)
    corner = known.log_angle(fitting.STARTING_CORNER_HZ)
    ground = SpectrumModel(float(np.log(gain)), float(np.log(white)), colour, corner, ())
    held = density(smooth, ground.alone(*lines))
    slow = max(float(np.trapezoid(np.maximum(d - held, 0), f)) - white, 0.1 * white)
    if drifts:
        starts = _starting_drifts(known, ground, slow, 2 * white / rate)
        starts = sorted(starts, key=lambda start: contrast(smooth, start, held))[:_MOST_DRIFTS]
    else:
        places = (*_TURBULENCE, _OVERDAMPED)
        starts = [ground.add(known.component("turbulence", *place, slow)) for place in places]
    best: FittedModel | None = None
    for start in starts:
        bound = float("inf") if best is None else best.contrast
        priors = known.priors(start)
        made = minimise(smooth, start, priors, held=held, bound=bound, accuracy=SEARCHED)
        best = fitting.likeliest(known, [best, made])
    return best


def _starting_drifts(
    search: Search, ground: SpectrumModel, slow: float, noise: float
) -> list[SpectrumModel]:
    """Return a drift and turbulence where fits may begin, for a slow variance and noise density."""
    ratio = fitting.DRIFT_RATIO
    hz = 2 * ratio * fitting.DRIFT_HZ
    powers = noise * np.array(_CROSSINGS_HZ) ** 2 * np.pi * ratio / hz  # of hz / (pi ratio f^2)
    drifts = [search.component("drift", hz, ratio, float(power)) for power in powers]
    places = product(_TURBULENCE, _SHARES)
    parts = [search.component("slow", *place, slow * share) for place, share in places]
    return [ground.add(drift, part) for drift, part in product(drifts, parts)]


def _smooth_background(data: LoopPeriodogram, gain: float) -> LoopPeriodogram:
    """Return the medians of a periodogram over bands, as means of what has no lines."""
    from scipy.special import gammaincinv

    power, f, count = data.power(gain), data.frequency_hz, data.count
    edges = np.searchsorted(f, np.geomspace(f[0], f[-1] * (1 + 1e-12), _BANDS))
    edges = np.unique(np.append(edges, f.size))
    shape = max(float(np.median(count)), 0.5)
    to_mean = shape / float(gammaincinv(shape, 0.5))
    bands = [(slice(a, b), to_mean if b - a > 2 else 1.0) for a, b in pairwise(edges)]
    rows = [
        (np.mean(f[band]), np.median(power[band]) * factor, np.sum(count[band]))
        for band, factor in bands
    ]
    centre, level, weight = np.array(rows).T
    zero = np.zeros_like(centre)
    return replace(
        data, frequency_hz=centre, measured=level, crossed=zero, corrected=zero, count=weight
    )


def _excess_bands(
    data: LoopPeriodogram, ratio: FloatArray, *, least: float, most: int
) -> list[tuple[float, int, int]]:
    """Return the bands with the most significant excess of power over a model.

    Each is what a model with its mean would add to the log-likelihood, and where it starts and
    stops. Bands of 1, 2, 4, ... bins are tried everywhere, at steps of a quarter of their width. A
    band of n values with the mean ratio R of power to model would gain ``n (R - 1 - log R)``.
    """
    f, step = data.frequency_hz, data.step_hz
    total, weight = (np.cumsum(np.append(0.0, values)) for values in (ratio, data.count))
    bands: list[tuple[float, int, int]] = []
    width = 1
    while width * step < _WIDEST * f[-1] and width < f.size:
        starts = np.arange(0, f.size - width + 1, max(1, width // 4))
        widest = np.maximum(_WIDEST * f[starts + width // 2], 4 * step)
        starts = starts[width * step <= widest]
        mean = np.maximum((total[starts + width] - total[starts]) / width, 1)
        gain = (weight[starts + width] - weight[starts]) * (mean - 1 - np.log(mean))
        best = np.argsort(gain)[::-1][: 8 * most]
        best = best[gain[best] > least]
        bands += [(float(gain[i]), int(starts[i]), int(starts[i]) + width) for i in best]
        width *= 2
    apart: list[tuple[float, int, int]] = []
    for worth, start, stop in sorted(bands, reverse=True):
        reach = max(3, stop - start)
        if all(start >= b + reach or stop <= a - reach for _, a, b in apart):
            apart.append((worth, start, stop))
    return apart[:most]


def _highest_excess(
    search: Search, power: FloatArray, model: FloatArray, band: slice, widest: float
) -> Component:
    """Return a line of the place, width and variance of the highest excess in a band of bins."""
    data, excess = search.data, power[band] - model[band]
    count = max(1, excess.size // 2).bit_length()
    each = [(2**k, _moving_mean(excess, 2**k)) for k in range(count)]
    # the smoothing at which the peak is highest over its scatter, which falls with its root
    _, smooth = max(each, key=lambda one: float(np.max(one[1])) * np.sqrt(one[0]))
    peak = int(np.argmax(smooth))
    low_enough = np.flatnonzero(smooth <= 0.5 * smooth[peak])
    low = low_enough[low_enough <= peak].max(initial=0)
    high = low_enough[low_enough >= peak].min(initial=smooth.size - 1)
    half = max(0.5 * float(high - low - 1), 0.5) * data.step_hz
    height = max(float(smooth[peak]), float(np.min(model[band])))
    frequency = float(data.frequency_hz[band.start + peak])
    ratio = min(max(half / frequency, _NARROWEST), widest)
    return search.component("line", frequency, ratio, np.pi * half * height)


def _moving_mean(series: FloatArray, width: int) -> FloatArray:
    """Return the mean over a width around each value, (n,), with zeros beyond the ends."""
    total = np.cumsum(np.append(0.0, series))
    last = np.arange(series.size) + (width - 1) // 2 + 1
    first = np.maximum(last - width, 0)
    return np.asarray((total[np.minimum(last, series.size)] - total[first]) / width)
