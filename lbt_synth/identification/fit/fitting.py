"""Fits of given components to one periodogram, and what each component must add to stay."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.scoring import EXACT, SEARCHED, Priors
from lbt_synth.identification.fit.spectrum_model import (
    Component,
    Kind,
    Spectra,
    SpectrumModel,
    damping_parameter,
)
from lbt_synth.identification.fit.whittle import (
    FittedModel,
    Model,
    component_density,
    contrast,
    contrasts,
    density,
    minimise,
    observe_information,
)
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import integer, number

LOWEST_LINE_HZ = 3.0
MOST_LINES = 20
DRIFT_RATIO = 300.0  # damping ratio of a drift: of its poles, one is beyond the frame rate
DRIFT_HZ, _DRIFT_WIDTH = 0.03, 2.0  # corner of a drift, and the width of its prior
GAINS: dict[str, Any] = {"above": 1e-4, "below": 1e4}  # of a sensor
PLAUSIBLE_GAINS = (0.2, 1.25)  # of a sensor whose commands are in the unit of its measurements
POSSIBLE_GAINS = (0.08, 2.5)  # of a sensor at all, with light lost or commands at half their size
_ANNOUNCED = 5.0  # log-likelihood that a line of known frequency must add
CHEAP = 9.0  # the same of what has one place: noise that is not white, the second of a close pair
_SKIRTS = 8.0  # half widths of the narrower one within which two lines are close
_HIGHEST = float(np.log(0.999 * np.pi))  # angle per frame of a line
_LOWEST = 0.1  # bins: a component below is a slope without a frequency
_SHIFTS = np.arange(-2, 2.01, 0.25)  # bins by which a narrow line is moved
_POWERS = (0.0, float(np.log(4)), float(-np.log(4)))

# Priors: mean and standard deviation. What the data leave open stays where it makes sense.
_FIXED, _NONE = (0.0, 0.0), (0.0, np.inf)
_GAIN_PRIOR = (np.log(0.7), 1.0)
_COLOUR_PRIOR = (0.0, 1.0)
STARTING_CORNER_HZ = 50.0
_TURBULENCE_WIDTH = 1.5  # width around 1 Hz of the frequency of a part of the turbulence
_DAMPING_PRIORS = {  # of the odds, but for the turbulence
    "turbulence": (np.log(0.45), 4.0),
    "slow": (0.0, 1.0),
    "line": (np.log(0.01 / 0.99), 4.0),
}
_LOOSE = 2.0  # width of the priors of a corner, and of a damping where the taper is not known

_FINE = 0.02  # of a frequency: a smooth spectrum does not change in such a band
_WIDEST_HZ, _SHARE = 3.0, 0.1  # of a group, and of what it holds of a line
_BINS = 10  # on either side of a line that stay single
_SIDELOBES = 64  # the same for a line narrower than _SMEARED bins, with the taper's sidelobes
_SMEARED = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Search:
    """A periodogram, and the models that may be fitted to it."""

    data: LoopPeriodogram
    gain: float | None = None  # sensor gain; None to find it
    lowest_line_hz: float = LOWEST_LINE_HZ  # below, a component belongs to the turbulence
    most_lines: int = MOST_LINES
    announced: Sequence[tuple[float, float]] = ()  # (frequency, error) of known lines [Hz]
    starting_gains: tuple[float, ...] = (0.6, 0.35, 1.0)  # of the sensor, where it is found

    def __post_init__(self) -> None:
        nyquist = self.data.frame_rate_hz / 2
        if self.gain is not None:
            number(self.gain, "sensor_gain", **GAINS)
        number(self.lowest_line_hz, "lowest_line_hz", at_least=0, below=nyquist)
        integer(self.most_lines, "most_lines", at_least=0)
        for frequency, error in self.announced:
            number(frequency, "an announced frequency", above=0, below=nyquist)
            number(error, "the error of an announced frequency", at_least=0)

    @property
    def finds_gain(self) -> bool:
        """Whether the sensor gain is fitted."""
        return self.gain is None and self.data.closed

    @property
    def price(self) -> float:
        """What a component must add to the logarithm of the likelihood."""
        return 0.5 * PARAMETERS * float(np.log(max(2.0, np.sum(self.data.count))))

    def log_angle(self, frequency_hz: float) -> float:
        """Return the logarithm of a frequency as an angle per frame."""
        return float(np.log(frequency_hz * self.data.angle_s))

    def component(self, kind: Kind, frequency_hz: float, ratio: float, power: float) -> Component:
        """Return a component of a frequency, a damping ratio and a variance."""
        damping = damping_parameter(kind, ratio)
        return Component(kind, self.log_angle(frequency_hz), damping, float(np.log(power)))

    def priors(self, model: Model) -> Priors:
        """Return the priors of a fit; components of two axes but for the first stay in the band."""
        spectra = Spectra((model,)) if isinstance(model, SpectrumModel) else model
        gain = _GAIN_PRIOR if self.finds_gain and len(spectra.axes) == 1 else _FIXED
        corner = (self.log_angle(STARTING_CORNER_HZ), _LOOSE)
        rows, frequencies = list[tuple[float, float]](), list[int]()
        for axis in spectra.axes:
            colour = _COLOUR_PRIOR if axis.colour else _FIXED
            rows += [gain, _NONE, colour, corner if axis.rolls_off else _FIXED]
            for c in axis.components:
                frequencies += [len(rows)] * (c is not axis.components[0])
                rows += self._component_priors(c)
        for shared in spectra.shared:
            frequencies.append(len(rows))
            ratio = _FIXED if shared.holds_ratio else _NONE
            rows += [*self._component_priors(shared), ratio, _FIXED]
        centre, width = np.array(rows).T
        priors = Priors(centre=centre, width=width)
        low, high = (np.full(centre.size, end) for end in priors.bounds)
        low[frequencies], high[frequencies] = self.log_angle(_LOWEST * self.data.step_hz), _HIGHEST
        return priors if len(spectra.axes) == 1 else replace(priors, bounds=(low, high))

    def _component_priors(self, component: Component) -> list[tuple[float, float]]:
        """Return the priors of frequency, damping and power."""
        frequency = (self.log_angle(1.0), _TURBULENCE_WIDTH)
        if component.kind == "drift":
            return [(self.log_angle(2 * DRIFT_RATIO * DRIFT_HZ), _DRIFT_WIDTH), _FIXED, _NONE]
        damping = _DAMPING_PRIORS[component.kind]
        if component.kind == "line":
            frequency = _NONE
            if self.data.duration_s is None:
                damping = damping[0], _LOOSE
        return [component.announced or frequency, damping, _NONE]

    def place(self, component: Component) -> tuple[float, float]:
        """Return the frequency and the half width of a component [Hz], at least a bin wide."""
        centre = component.frequency / self.data.angle_s
        return centre, max(centre * component.damping_ratio, self.data.step_hz)

    def covers(self, component: Component) -> bool:
        """Whether a component lies between the first bin and the Nyquist frequency."""
        lowest = self.log_angle(_LOWEST * self.data.step_hz)
        return bool(lowest < component.log_frequency < _HIGHEST)

    def merge(self, model: Model) -> LoopPeriodogram:
        """Return means over groups of bins within which a model is nearly constant."""
        f, step = self.data.frequency_hz, self.data.step_hz
        size = np.maximum(step, np.minimum(_FINE * f, _WIDEST_HZ))
        for line in model.lines:
            centre, half_width = self.place(line)
            fine = _SIDELOBES if half_width < _SMEARED * step else _BINS
            reach = fine * step + _WIDEST_HZ / _SHARE / 2  # beyond, this limit is wider
            near = slice(*np.searchsorted(f, [centre - reach, centre + reach]))
            away = np.maximum(np.abs(f[near] - centre) - fine * step, 0)
            wide = _SHARE * np.maximum(half_width, 2 * away)
            size[near] = np.minimum(size[near], np.maximum(step, wide))
        group = np.floor(np.cumsum(step / size) - 1e-9)
        return self.data.merge(np.flatnonzero(np.diff(group, prepend=-np.inf) > 0))


def fit(
    search: Search,
    start: Model,
    *,
    better_than: FittedModel | None = None,
    margin: float = 0.0,
    accuracy: float = SEARCHED,
) -> FittedModel | None:
    """Fit all parameters; None if no fit settles.

    Components of one axis that leave the band, from the first bin to the Nyquist frequency, are
    dropped; those of two axes stay at its ends. A fit is given up where its log-likelihood does
    not reach that of ``better_than`` minus a margin.
    """
    data, bound = search.merge(start), float("inf")
    if better_than is not None:
        bound = contrast(data, better_than.spectra) + margin
    found = minimise(data, start, search.priors(start), bound=bound, accuracy=accuracy)
    if found is None or found.contrast > bound:
        return None
    if isinstance(start, Spectra):
        return found
    inside = found.spectrum.keep(search.covers)
    if len(inside.components) < len(start.components):
        return fit(search, inside, better_than=better_than, margin=margin, accuracy=accuracy)
    return replace(found, contrast=contrast(search.data, found.spectrum))


def refit(search: Search, start: SpectrumModel) -> FittedModel | None:
    """Fit a model of other data to these; None if no fit settles."""
    if not search.finds_gain:
        start = replace(start, log_gain=float(np.log(search.gain or 1.0)))
    if not start.rolls_off:
        start = replace(start, log_corner=search.log_angle(STARTING_CORNER_HZ))
    return fit(search, start)


def likeliest(search: Search, fits: Iterable[FittedModel | None]) -> FittedModel | None:
    """Return the fit of the least cost; None if none of them settled."""
    settled = (model for model in fits if model is not None)
    return min(settled, key=lambda model: cost(search, model), default=None)


def simplify(search: Search, model: FittedModel) -> FittedModel:
    """Return the model without roll-off or colour, where that adds too little."""
    for leave_out in (SpectrumModel.without_roll_off, SpectrumModel.without_colour):
        plainer = leave_out(model.spectrum)
        less = None if plainer == model.spectrum else fit(search, plainer)
        if less is not None and cost(search, less) < cost(search, model):
            model = less
    return model


def prune(search: Search, model: FittedModel, *, thorough: bool = False) -> FittedModel:
    """Drop the components that add less than they must, the least first.

    Others may take over what a wide one, or one of a close pair, explains, but only after a long
    fit: ``thorough`` makes it.
    """
    trials, spectrum = [], model.spectrum
    data = search.merge(spectrum)
    whole = contrast(data, spectrum)
    for i, component in enumerate(spectrum.components):
        close = close_line(search, spectrum, i)
        less = _drop(data, spectrum, i) if close is None else _unite(search, spectrum, i, close)
        if less is not None:
            required = required_evidence(search, spectrum, i)
            spare = contrast(data, less) - whole - 4 * required
            patient = thorough and (close is not None or not component.is_narrow)
            if patient or spare <= 0:
                trials.append((spare, required, less, None if patient else model))
    for _, required, less, bound in sorted(trials, key=lambda trial: trial[0]):
        made = fit(search, less, better_than=bound, margin=required)
        if made is not None and cost(search, made) < cost(search, model):
            return prune(search, made, thorough=thorough)
    return model


def _drop(data: LoopPeriodogram, spectrum: SpectrumModel, i: int) -> SpectrumModel | None:
    """Return the model without a component; None if that is its only turbulence.

    A wide component may have taken the place of the noise: its white part then becomes noise.
    """
    less, noise = spectrum.drop(i), float(np.exp(spectrum.log_noise))
    if less is None:
        return None
    lost = density(data, spectrum) - density(data, less)
    white = float(np.min(lost)) * data.frame_rate_hz / 2
    return replace(less, log_noise=float(np.log(noise + white))) if white > noise else less


def _unite(search: Search, spectrum: SpectrumModel, i: int, close: int) -> SpectrumModel:
    """Return the model with one line for two, of their power and the means of their places."""
    pair = [spectrum.components[k] for k in (close, i)]
    power = np.exp([line.log_power for line in pair])
    centre, half = np.average([search.place(line) for line in pair], axis=0, weights=power)
    ratio = min(float(half / centre), 0.5)
    line = search.component("line", float(centre), ratio, float(np.sum(power)))
    line = replace(line, announced=pair[0].announced or pair[1].announced)
    return spectrum.exchange(close, line).exchange(i)


def required_evidence(
    search: Search, spectrum: SpectrumModel, i: int, *, earlier: bool = False
) -> float:
    """Return what a component must add to the logarithm of the likelihood.

    Less where its place was not searched for: an announced line, or one of a close pair
    (with ``earlier``, of a pair with one of the components before it).
    """
    if spectrum.components[i].announced is not None:
        return _ANNOUNCED
    is_alone = close_line(search, spectrum, i, earlier=earlier) is None
    return search.price if is_alone else CHEAP


def close_line(
    search: Search, spectrum: SpectrumModel, i: int, *, earlier: bool = False
) -> int | None:
    """Return the nearest of the lines (``earlier``: before it) that share skirts with line i.

    All lines lie in the skirts of a wide resonance, which does not say where to look for them.
    """
    if spectrum.components[i].kind != "line":
        return None
    centre, half = search.place(spectrum.components[i])
    near = {}
    for k, other in enumerate(spectrum.components[: i if earlier else None]):
        if k != i and other.kind == "line":
            at, its_half = search.place(other)
            if abs(centre - at) < _SKIRTS * min(half, its_half):
                near[k] = abs(centre - at)
    return min(near, key=near.__getitem__, default=None)


def cost(search: Search, model: FittedModel) -> float:
    """Return the contrast of a model plus what the criterion asks for all that it has."""
    spectrum = model.spectrum
    first, *rest = spectrum.components
    # the same for any order of the search
    rest = sorted(rest, key=lambda component: component.log_frequency)
    ordered, others = replace(spectrum, components=(first, *rest)), range(1, 1 + len(rest))
    prices = [required_evidence(search, ordered, i, earlier=True) for i in others]
    shapes = CHEAP * bool(spectrum.colour) + search.price / PARAMETERS * spectrum.rolls_off
    return model.contrast + sum(prices) + shapes


def add_evidence(search: Search, model: FittedModel) -> FittedModel:
    """Return the model at its minimum, with what each component adds and exact information."""
    model = fit(search, model.spectrum, accuracy=EXACT) or model
    spectrum = model.spectrum
    exact = observe_information(search.merge(spectrum), model, search.priors(spectrum))
    evidence = [
        contrast(search.data, spectrum.exchange(i)) - model.contrast
        for i in range(1, len(spectrum.components))
    ]
    return replace(exact, evidence=(float("inf"), *evidence))


def centre_line(search: Search, spectrum: SpectrumModel, i: int) -> SpectrumModel:
    """Put a line that is hardly resolved where it fits best within two bins.

    The sidelobes of the taper make as many places where a fit would stay.
    """
    step, line = search.data.step_hz, spectrum.components[i]
    centre, half = search.place(line)
    if half > 2 * step or centre <= 3 * step:
        return spectrum
    data = search.data.window(centre - _SIDELOBES * step, centre + _SIDELOBES * step)
    rest = density(data, spectrum.exchange(i))
    for shifts in (_SHIFTS, _SHIFTS / 8):  # the place of a sinusoid is known to a part of a bin
        moves = product(np.log1p(shifts * step / centre), _POWERS)
        # the width stays
        trials = [line, *(line.shift(move, -move, power) for move, power in moves)]
        lines = [component_density.__wrapped__(data, trial) for trial in trials]  # none comes again
        best = int(np.argmin(contrasts(data, spectrum.gain, rest + np.array(lines))))
        line = trials[best]
    return spectrum.exchange(i, line)
