"""The search for the components of a spectrum, and for their number.

The model grows from turbulence over white noise, fitted to medians over bands, which lines hardly
touch. Bands with too much power become components, all parameters are fitted together, and what
adds less than its price is dropped. A model of earlier data is only polished.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
from scipy.ndimage import uniform_filter1d

from lbt_synth.errors import NumericalError
from lbt_synth.identification.fit import fitting
from lbt_synth.identification.fit.fitting import GAIN_STEP, PLAUSIBLE_GAINS, TYPICAL_GAIN, Search
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import (
    Background,
    Component,
    SpectrumModel,
    damping_parameter,
)
from lbt_synth.identification.fit.whittle import SEARCHED, FittedModel, contrast, density, minimise
from lbt_synth.models.resonance_spectrum import WIDE_DAMPING
from lbt_synth.models.vibration import MOST_SECTIONS
from lbt_synth.validation import FloatArray

_CLEARLY = 1.0  # log-likelihood that a trial must save at least
FEW_ROUNDS, _MOST_ROUNDS = 3, 12  # of a quick search, and of a whole one
_HALF = float(np.log(0.5))
_MOST_SLOW = 2  # parts of the turbulence beside the first
_COLOUR = 0.3  # of the noise, where a fit begins
_TURBULENCE = ((0.5, 0.55), (5.0, 0.55), (2.0, 30.0))  # frequency [Hz] and damping: starts of a fit
_CROSSINGS_HZ = np.geomspace(1.0, 100.0, 5)  # where a drift beside turbulence may meet the noise
_OVERDAMPED = 3.0  # damping ratio of turbulence that may stand for a drift
_SHARES = (1.0, 0.1)  # of the slow variance in that turbulence
_WIDEST_LINE = 0.98  # damping ratio
_BANDS = 80  # of the background
_WIDEST = 0.3  # of its frequency: a band that is tried, and the damping ratio of a new component
_NARROWEST = 1e-4  # damping ratio of a new component
_BESIDE = 0.08  # of its frequency: lines that are nearer may be one bump
_ROUGH = 30.0  # prices: a bump of several lines that begins with less is not fitted
_TO_HALF = 2 * float(np.log(2))  # square of a Gaussian's half width over its variance
_OTHER_GAINS = (0.45, 1.05)  # of a sensor, from which models that are as likely are sought
_AROUND = (0.8, 1.25)  # of a gain: where they are sought, too
_AS_LIKELY = 5.0  # log-likelihood by which one of two gains is excluded

Excess = tuple[float, Component]  # what it would add to the log-likelihood, and a component


def find_models(
    search: Search, start: SpectrumModel | None = None
) -> tuple[FittedModel, list[FittedModel]]:
    """Return the likeliest model of one axis, and all that are as likely.

    Wide resonances and a drift fit most spectra that fall, and so does a colour of the noise; each
    of them can explain what a wrong gain leaves. The places of lines cannot.
    """
    model = find_components(search, start)
    spectrum = model.spectrum
    turbulence, *others = spectrum.components
    narrow = (c for c in others if c.is_narrow or c.kind == "slow")
    plain = replace(spectrum, components=(turbulence, *narrow))
    recoloured = plain.with_background(colour=0.0 if spectrum.background.colour else _COLOUR)
    if start is not None or plain == spectrum:
        rival = fitting.fit(search, spectrum.with_background(colour=recoloured.background.colour))
    else:
        rival = find_components(search, recoloured)
    rivals = [model] if rival is None else [model, rival]
    best = min(rivals, key=lambda rival: _cost_of_noise(search, rival))
    if search.finds_gain and start is None and not _is_clear(best):
        for _ in range(2):  # a clearly better one has rivals of its own
            begun, rivals = best, [*rivals, *_rivals(search, best.spectrum)]
            best = min(rivals, key=lambda rival: _cost_of_noise(search, rival))
            if _cost_of_noise(search, best) > _cost_of_noise(search, begun) - _CLEARLY:
                break
            best = fitting.prune(search, best, thorough=True)
    near = [
        rival
        for rival in rivals
        if min(
            fitting.cost(search, rival) - fitting.cost(search, best),
            _cost_of_noise(search, rival) - _cost_of_noise(search, best),
            _cost_beside(search, rival, best),
        )
        < _AS_LIKELY
    ]
    return (best if best is model else fitting.prune(search, best, thorough=True)), near


def _rivals(search: Search, spectrum: SpectrumModel) -> Iterator[FittedModel]:
    """Yield models that begin at other gains, and without each flat resonance."""
    gain = spectrum.background.gain
    # the components of an implausible gain may be those of what it explains
    start = spectrum if _is_plausible(gain) else None
    gains = [*_OTHER_GAINS, *(gain * np.array(_AROUND)).tolist()]
    trials = [
        spectrum.exchange(i)
        for i, component in enumerate(spectrum.components)
        if i and component.damping_ratio > WIDE_DAMPING / 2
    ]
    for other in gains:
        if abs(np.log(other / gain)) >= GAIN_STEP:
            with suppress(NumericalError):
                held = replace(search, gain=other)
                trials.append(find_components(held, start, rounds=FEW_ROUNDS).spectrum)
    for trial in trials:
        if (rival := fitting.fit(search, trial)) is not None:
            yield rival


def _is_clear(model: FittedModel) -> bool:
    """Whether nothing could explain another gain than that of a model."""
    background, turbulence = model.spectrum.background, model.spectrum.components[0]
    narrow = all(c.is_narrow for c in model.spectrum.lines) and not background.colour
    plausible = _is_plausible(background.gain) and model.errors.background.log_gain < GAIN_STEP
    return narrow and plausible and turbulence.damping_ratio < _OVERDAMPED


def _is_plausible(gain: float) -> bool:
    return PLAUSIBLE_GAINS[0] <= gain <= PLAUSIBLE_GAINS[1]


def _cost_beside(search: Search, rival: FittedModel, best: FittedModel) -> float:
    """Return what a rival of a plausible gain costs more, if a parameter costs 1 as in Akaike's."""
    more = len(rival.spectrum.components) - len(best.spectrum.components)
    if more > 1 or not _is_plausible(rival.spectrum.background.gain):
        return float("inf")  # with several more, some gain explains all spectra
    costs = [
        fitting.cost(search, model)
        - fitting.total_price(search, model.spectrum) * (1 - 1 / search.parameter_price)
        for model in (rival, best)
    ]
    return costs[0] - costs[1]


def _cost_of_noise(search: Search, model: FittedModel) -> float:
    """Return the cost of a model in which wide resonances count twice, and narrower ones less."""
    widths = [c.damping_ratio / WIDE_DAMPING for c in model.spectrum.lines]
    return fitting.cost(search, model) + search.price * sum(min(1.0, w**4) for w in widths)


def find_components(
    search: Search, start: SpectrumModel | None = None, *, rounds: int = _MOST_ROUNDS
) -> FittedModel:
    """Find the model of one axis: add components, prune, move lines; or polish an earlier model."""
    if start is not None and not search.finds_gain:
        start = start.with_background(log_gain=float(np.log(search.gain or 1.0)))
    model = _begin(search) if start is None else fitting.fit(search, start)
    if model is None and start is not None:
        return find_components(search, rounds=rounds)
    if model is None:
        raise NumericalError(
            "the likelihood of the spectrum is not finite. Check the units of the series."
        )
    model = fitting.prune(search, model)
    for _ in range(rounds if start is None else FEW_ROUNDS):
        better = _improve(search, model, moves=start is None)
        if better is None:
            break
        model = better
    return fitting.prune(search, fitting.simplify(search, model), thorough=start is None)


def _improve(search: Search, model: FittedModel, *, moves: bool) -> FittedModel | None:
    """Return the first trial that is clearly better; None if none is."""
    least, price = fitting.cost(search, model), fitting.total_price(search, model.spectrum)
    for trial in _trials(search, model.spectrum, moves):
        margin = max(0.0, price - fitting.total_price(search, trial))
        better = fitting.fit(search, trial, better_than=model, margin=margin)
        better = None if better is None else fitting.prune(search, better)
        if better is not None and fitting.cost(search, better) < least - _CLEARLY:
            return better
    return None


def _trials(search: Search, spectrum: SpectrumModel, moves: bool) -> Iterator[SpectrumModel]:
    """Yield models with new lines, other turbulence, or lines in other places."""
    excesses = find_excesses(search, spectrum)
    excesses = [excess for excess in excesses if excess[0] > 0.25 * excesses[0][0]]
    while excesses:
        yield _add_centred(search, spectrum, excesses)
        excesses = excesses[: len(excesses) // 2]
    if all(c.kind != "drift" for c in spectrum.components):
        yield _add_drift(search, spectrum)
    yield from _bumps(search, spectrum)
    for i, component in enumerate(spectrum.components):
        if moves and component.kind == "line":
            yield from _line_moves(search, spectrum, i)
    if any(c.kind == "slow" for c in spectrum.components):
        lines = [c for c in spectrum.components if c.kind == "line"]
        ground = fit_background(search, spectrum.background.gain, lines)
        if ground is not None:
            yield ground.spectrum.add(*lines)


def _begin(search: Search) -> FittedModel | None:
    """Fit the background and the clear lines, with the gain held until these and a drift stand."""
    gain = TYPICAL_GAIN if search.finds_gain else search.gain or 1.0
    held = replace(search, gain=gain)
    model = fit_background(held, gain)
    for _ in range(FEW_ROUNDS):
        excesses = [] if model is None else find_excesses(held, model.spectrum)
        clear = [one for one in excesses if one[0] > max(2 * search.price, 0.02 * excesses[0][0])]
        if model is None or not clear:
            break
        model = fitting.fit(held, _add_centred(held, model.spectrum, clear))
    if model is None:
        return None
    drifting = fitting.fit(held, _add_drift(held, model.spectrum), better_than=model)
    model = fitting.likeliest(held, [model, drifting]) or model
    return model if not search.finds_gain else fitting.fit(search, model.spectrum)


def _add_drift(search: Search, spectrum: SpectrumModel) -> SpectrumModel:
    """Return the model with a drift and turbulence beside its lines, where both fit best."""
    data, background = search.merge(spectrum), spectrum.background
    slow = [c for c in spectrum.components if c.kind not in ("line", "drift")]
    lines = [c for c in spectrum.components if c.kind == "line"]
    noise = 2 / search.data.frame_rate_hz * float(np.exp(background.log_noise))
    # the density of a drift of variance P above its corner is 2 P corner / (pi f^2)
    powers = noise * np.square(_CROSSINGS_HZ) * np.pi / (2 * fitting.DRIFT_HZ)
    drifts = [search.drift(fitting.DRIFT_HZ, power) for power in powers.tolist()]
    drifts += [  # whose place overdamped turbulence has taken, as slow parts that of turbulence
        search.drift(search.place(c)[0] / (2 * c.damping_ratio), float(np.exp(c.log_power)))
        for c in slow
        if c.damping_ratio > _OVERDAMPED
    ]
    variance = float(np.sum(np.exp([c.log_power for c in slow])))
    starts = [replace(c, kind="turbulence") for c in slow]
    starts += [
        search.component("turbulence", hz, ratio, variance * share)
        for (hz, ratio), share in product(_TURBULENCE[:2], _SHARES)
    ]
    trials = [
        replace(spectrum, components=(turbulence, *lines, drift))
        for drift, turbulence in product(drifts, starts)
    ]
    return min(trials, key=lambda trial: contrast(data, trial))


def _add_centred(search: Search, spectrum: SpectrumModel, new: Sequence[Excess]) -> SpectrumModel:
    """Return the model with more components, each where it fits best."""
    model = spectrum.add(*(component for _, component in new))
    for i in range(len(spectrum.components), len(model.components)):
        model = fitting.centre_line(search, model, i)
    return model


def find_excesses(search: Search, spectrum: SpectrumModel) -> list[Excess]:
    """Find components where a model lacks power, as many as there may be more lines."""
    room = search.most_lines - len(spectrum.lines)
    if room <= 0:
        return []
    data = search.data
    power, model = data.power(spectrum.background.gain), density(data, spectrum)
    excesses = []
    for worth, *ends in excess_bands(data, power / model, least=search.price, most=room):
        component = _highest_excess(search, power, model, slice(*ends), _WIDEST)
        if search.place(component)[0] < search.lowest_line_hz:
            slow = search.component("slow", search.place(component)[0], _WIDEST, 1.0)
            component = replace(slow, log_power=component.log_power)
        excesses.append((worth, component))
    if sum(c.kind == "slow" for c in spectrum.components) >= _MOST_SLOW:
        return [(worth, component) for worth, component in excesses if component.kind == "line"]
    return excesses


def _bumps(search: Search, spectrum: SpectrumModel) -> Iterator[SpectrumModel]:
    """Yield models with one bump in the place of neighbouring lines, or of a wide resonance."""
    components, data = spectrum.components, search.merge(spectrum)
    least = contrast(data, spectrum)
    lines = [i for i, c in enumerate(components) if c.kind == "line" and c.damping_ratio < _WIDEST]
    lines.sort(key=lambda i: components[i].log_frequency)
    clusters = list[list[int]]()
    for i in lines:
        c = components[i]
        last = components[clusters[-1][-1]] if clusters else None
        if last and c.log_frequency - last.log_frequency < _BESIDE + c.damping_ratio:
            clusters[-1].append(i)
        else:
            clusters.append([i])
    for cluster in clusters:
        first, counts, groups = components[cluster[0]], {2, MOST_SECTIONS}, [cluster]
        if len(cluster) == 1:
            if search.place(first)[1] < fitting.RESOLVED * search.data.step_hz:
                continue
            counts = {first.sections - 1, first.sections + 1} & set(range(1, MOST_SECTIONS + 1))
        elif len(cluster) > 2:  # the highest may stand upon a bump of the others
            heights = [components[i].log_power - components[i].damping for i in cluster]
            groups.append([i for i in cluster if i != cluster[int(np.argmax(heights))]])
        for group, sections in product(groups, sorted(counts)):
            others = (c for i, c in enumerate(components) if i not in group)
            bump = _bump([components[i] for i in group], sections)
            trial = replace(spectrum, components=(*others, bump))
            rough = 1.0 if len(group) == 1 else _ROUGH
            if contrast(data, trial) < least + rough * search.price:
                yield trial


def _bump(members: Sequence[Component], sections: int) -> Component:
    """Return one component of the power, centre and width of some lines."""
    power = np.exp([c.log_power for c in members])
    place = np.array([c.frequency for c in members])
    half = np.array([c.damping_ratio * c.frequency * _half_width(c.sections) for c in members])
    centre = float(np.average(place, weights=power))
    spread = float(np.average((place - centre) ** 2, weights=power))
    width = float(np.sqrt(_TO_HALF * spread + np.average(half, weights=power) ** 2))
    ratio = min(width / centre / _half_width(sections), _WIDEST_LINE)
    return replace(
        members[0],
        log_frequency=float(np.log(centre)),
        damping=damping_parameter("line", ratio),
        log_power=float(np.log(np.sum(power))),
        sections=sections,
    )


def _half_width(sections: int) -> float:
    """Return the half width at half height of sections in series over that of one."""
    return float(np.sqrt(2 ** (1 / sections) - 1))


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
    rest, power = density(data, spectrum.exchange(i)), data.power(spectrum.background.gain)
    again = _highest_excess(search, power, rest, slice(int(start), int(stop)), 0.5)
    if abs(search.place(again)[0] - centre) > 0.5 * half + step:
        yield spectrum.exchange(i, again)
    if half > 3 * step and len(spectrum.lines) < search.most_lines:
        lower, upper = (
            line.shift(float(np.log(1 + side * half / centre)), _HALF, _HALF) for side in (-1, 1)
        )
        yield spectrum.exchange(i, lower).add(upper)


def fit_background(
    search: Search, gain: float, lines: Sequence[Component] = ()
) -> FittedModel | None:
    """Fit turbulence and noise beside lines at a sensor gain; None if no fit settles."""
    smooth = _smooth_background(search.data, gain)
    f, d, rate = smooth.frequency_hz, smooth.measured, smooth.frame_rate_hz
    white = max(float(np.median(d[f >= 0.6 * f[-1]])) * rate / 2, float(np.finfo(float).tiny))
    held = replace(search, gain=gain)
    corner = held.log_angle(fitting.STARTING_CORNER_HZ)
    background = Background(float(np.log(gain)), float(np.log(white)), 0.0, corner)
    ground = SpectrumModel((background,), ())
    beside = density(smooth, ground.alone(*lines))
    slow = max(float(np.trapezoid(np.maximum(d - beside, 0), f)) - white, 0.1 * white)
    best: FittedModel | None = None
    for place in _TURBULENCE:
        start = ground.add(held.component("turbulence", *place, slow))
        bound = float("inf") if best is None else best.contrast
        priors = held.priors(start)
        model = minimise(smooth, start, priors, held=beside, bound=bound, accuracy=SEARCHED)
        best = fitting.likeliest(held, [best, model])
    return best


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


def excess_bands(
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
        above = np.flatnonzero(gain > least)
        best = above[np.argsort(gain[above])[::-1][: 8 * most]]
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
    means = [(2**k, uniform_filter1d(excess, 2**k, mode="constant")) for k in range(count)]
    # the smoothing at which the peak is highest over its scatter, which falls with its root
    _, smooth = max(means, key=lambda mean: float(np.max(mean[1])) * np.sqrt(mean[0]))
    peak = int(np.argmax(smooth))
    low_enough = np.flatnonzero(smooth <= 0.5 * smooth[peak])
    low = low_enough[low_enough <= peak].max(initial=0)
    high = low_enough[low_enough >= peak].min(initial=smooth.size - 1)
    half = max(0.5 * float(high - low - 1), 0.5) * data.step_hz
    height = max(float(smooth[peak]), float(np.min(model[band])))
    frequency = float(data.frequency_hz[band.start + peak])
    ratio = min(max(half / frequency, _NARROWEST), widest)
    return search.component("line", frequency, ratio, np.pi * half * height)
