"""Fits of given components to a periodogram, and what each component must add to stay.

One criterion decides: the log-likelihood less the price of all that a model has. The Bayesian
price of a component is ``3 / 2 log n``, for three parameters among n values, and that of a corner
``1 / 2 log n`` (G. Schwarz, Ann. Statist. 6, 461 (1978), doi:10.1214/aos/1176344136).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import (
    BACKGROUND,
    COLOUR,
    GAIN,
    Component,
    Kind,
    SpectrumModel,
    damping_parameter,
)
from lbt_synth.identification.fit.whittle import (
    EXACT,
    HOPE,
    SEARCHED,
    SKIRT,
    FittedModel,
    Priors,
    contrast,
    contrasts,
    density,
    minimise,
    observe_information,
    part_densities,
)
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import integer, number

LOWEST_LINE_HZ = 3.0
MOST_LINES = 20
DRIFT_RATIO = 300.0  # damping ratio of a drift: of its poles, one is beyond the frame rate
DRIFT_HZ = 0.03  # corner of a drift, before the data say another
GAINS: dict[str, Any] = {"above": 1e-4, "below": 1e4}  # of a sensor
PLAUSIBLE_GAINS = (0.2, 1.25)  # of a sensor whose commands are in the unit of its measurements
POSSIBLE_GAINS = (0.08, 2.5)  # of a sensor at all, with light lost or commands at half their size
GAIN_ERROR = 0.5  # of the logarithm of a sensor gain, before the data say more
GAIN_STEP = 0.05  # of the logarithm of a gain: nearer ones are as good as the same
TYPICAL_GAIN = 0.7  # of a sensor, before the data say more
_COLOURED = 9.0  # log-likelihood that a colour must add, which a wrong gain can explain, too
_MOST_COLOUR = float(np.arctanh(0.8))  # beyond, it is a drift, no white noise for a design
_WORTH = 1e-3  # of the innovations' variance, by which a line upon a bump must lower it
_FAR = 2.0  # half widths of a section from the middle of a bump: what lies beyond is not upon it
# half width times frequency, angles per frame, below which the process of a bump of so many
# sections has an error of 1e-4 in double precision
_STEEPEST = {3: 2e-4, 4: 1e-3}
_SEED = 0.01  # of the lowest density: noise from which a fit begins at least
_HIGHEST = float(np.log(0.999 * np.pi))  # angle per frame of a line
_FASTEST_HZ = 10.0  # natural frequency of turbulence: above, it would be a resonance
_LOWEST = 0.1  # bins: a component below is a slope without a frequency
_SHIFTS = np.arange(-2, 2.01, 0.25)  # bins by which a narrow line is moved
_POWERS = np.log([1.0, 4.0, 0.25])  # by which its power changes there

# Priors: mean and standard deviation of logarithms and odds. What the data leave open stays where
# it makes sense: corners and frequencies of the turbulence within a factor of e^2.
_FIXED, _NONE = (0.0, 0.0), (0.0, np.inf)
STARTING_CORNER_HZ = 50.0
_WIDTH = 2.0
_DAMPING: dict[Kind, tuple[float, float]] = {
    "turbulence": (float(np.log(0.45)), 4.0),
    "slow": (float(np.log(0.45)), 1.0),
    "drift": _FIXED,
    "line": (float(np.log(0.01)), 4.0),
}

_FINE = 0.02  # of a frequency: a smooth spectrum does not change in such a band
_WIDEST_HZ, _SHARE = 3.0, 0.1  # of a group, and of what it holds of a line
_BINS = 10  # on either side of a line that stay single; SKIRT of a line as narrow as bins
RESOLVED = 3  # bins: a narrower line has the sidelobes of the taper, a wider one flanks of its own


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Search:
    """A periodogram, and the models that may be fitted to it."""

    data: LoopPeriodogram
    gain: float | None = None  # sensor gain; None to find it
    lowest_line_hz: float = LOWEST_LINE_HZ  # below, a component belongs to the turbulence
    most_lines: int = MOST_LINES
    gain_error: float = GAIN_ERROR  # of the logarithm of a gain around the typical one, beforehand

    def __post_init__(self) -> None:
        nyquist = self.data.frame_rate_hz / 2
        if self.gain is not None:
            number(self.gain, "sensor_gain", **GAINS)
        number(self.lowest_line_hz, "lowest_line_hz", at_least=0, below=nyquist)
        integer(self.most_lines, "most_lines", at_least=0)

    @property
    def finds_gain(self) -> bool:
        """Whether the sensor gain is fitted."""
        return self.gain is None and self.data.closed

    @property
    def parameter_price(self) -> float:
        """What one parameter must add to the logarithm of the likelihood."""
        return 0.5 * float(np.log(max(2.0, np.sum(self.data.count))))

    @property
    def price(self) -> float:
        """What a component must add to the logarithm of the likelihood."""
        return PARAMETERS * self.parameter_price

    def log_angle(self, frequency_hz: float) -> float:
        """Return the logarithm of a frequency as an angle per frame."""
        return float(np.log(frequency_hz * self.data.angle_s))

    def component(self, kind: Kind, frequency_hz: float, ratio: float, power: float) -> Component:
        """Return a component of a frequency, a damping ratio and a variance."""
        damping = damping_parameter(kind, ratio)
        return Component(kind, self.log_angle(frequency_hz), damping, float(np.log(power)))

    def drift(self, corner_hz: float, power: float) -> Component:
        """Return a drift of a corner and a variance."""
        return self.component("drift", 2 * DRIFT_RATIO * corner_hz, DRIFT_RATIO, power)

    def priors(self, spectrum: SpectrumModel) -> Priors:
        """Return the priors of a fit, in which lines stay in the band.

        Sensors and filters make the noise of neighbouring frames alike, hardly ever opposite.
        """
        prior = (float(np.log(TYPICAL_GAIN)), self.gain_error)
        gain = prior if self.finds_gain and len(spectrum.axes) == 1 else _FIXED
        corner = (self.log_angle(STARTING_CORNER_HZ), _WIDTH)
        rows = list[tuple[float, float]]()
        for axis in spectrum.axes:
            colour = (0.0, _WIDTH) if axis.colour else _FIXED
            rows += [gain, _NONE, colour, corner if axis.rolls_off else _FIXED]
        for c in spectrum.components:
            ratio = _NONE if c.axis is None and c.kind == "line" else _FIXED
            rows += [*self._resonance_priors(c), _NONE, ratio][: spectrum.width]
        centre, width = np.array(rows).T
        priors = Priors(centre=centre, width=width)
        low, high = (np.full(centre.size, end) for end in priors.bounds)
        axes = BACKGROUND * np.arange(len(spectrum.axes))
        low[axes + GAIN], high[axes + GAIN] = np.log(2 * GAINS["above"]), np.log(GAINS["below"] / 2)
        low[axes + COLOUR], high[axes + COLOUR] = 0.0, _MOST_COLOUR
        for i, c in enumerate(spectrum.components):
            if c.kind == "line":
                low[spectrum.place(i)] = self.log_angle(_LOWEST * self.data.step_hz)
                high[spectrum.place(i)] = _HIGHEST
                if least := _STEEPEST.get(c.sections):
                    narrowest = min(2 * least / c.frequency**2, 0.9)
                    low[spectrum.place(i) + 1] = damping_parameter("line", narrowest)
                    low[spectrum.place(i)] = c.log_frequency - np.log(2) / 2
            elif c.kind != "drift":
                high[spectrum.place(i)] = self.log_angle(_FASTEST_HZ)
        return replace(priors, bounds=(low, high))

    def _resonance_priors(self, component: Component) -> tuple[tuple[float, float], ...]:
        """Return the priors of the frequency and the damping of a component."""
        centre, width = _DAMPING[component.kind]
        if component.kind == "line":  # half as wide where the taper of a density is not known
            return _NONE, (centre, width if self.data.duration_s else 0.5 * width)
        usual_hz = 2 * DRIFT_RATIO * DRIFT_HZ if component.kind == "drift" else 1.0
        return (self.log_angle(usual_hz), _WIDTH), (centre, width)

    def place(self, component: Component) -> tuple[float, float]:
        """Return the frequency and the half width of a component [Hz], at least a bin wide."""
        centre = component.frequency / self.data.angle_s
        return centre, max(centre * component.damping_ratio, self.data.step_hz)

    def merge(self, spectrum: SpectrumModel) -> LoopPeriodogram:
        """Return means over groups of bins within which a model is nearly constant."""
        f, step = self.data.frequency_hz, self.data.step_hz
        widths_hz = np.minimum(_FINE * f, _WIDEST_HZ)
        for line in spectrum.lines:
            centre, half_width = self.place(line)
            fine = SKIRT if half_width < RESOLVED * step else _BINS
            reach = fine * step + _WIDEST_HZ / _SHARE / 2  # beyond, this limit is wider
            band = slice(*np.searchsorted(f, [centre - reach, centre + reach]))
            away = np.maximum(np.abs(f[band] - centre) - fine * step, 0)
            wide = _SHARE / line.sections * np.maximum(half_width, 2 * away)
            widths_hz[band] = np.minimum(widths_hz[band], wide)
        return self.data.merge(widths_hz)


def fit(
    search: Search,
    start: SpectrumModel,
    *,
    better_than: FittedModel | None = None,
    margin: float = 0.0,
    accuracy: float = SEARCHED,
) -> FittedModel | None:
    """Fit all parameters; None if no fit settles within a margin of ``better_than``."""
    data, bound = search.merge(start), float("inf")
    if len(start.axes) == 1:  # a noise of nothing has no slope
        least = _SEED * float(np.min(density(data, start))) * data.frame_rate_hz / 2
        noise = max(start.background.log_noise, float(np.log(least)))
        start = start.with_background(log_noise=noise)
    if better_than is not None:
        bound = contrast(data, better_than.spectrum) + margin
    model = minimise(data, start, search.priors(start), bound=bound, accuracy=accuracy)
    if model is None or model.contrast > bound:
        return None
    return replace(model, contrast=contrast(search.data, model.spectrum))


def likeliest(search: Search, fits: Iterable[FittedModel | None]) -> FittedModel | None:
    """Return the fit of the least cost; None if none of them settled."""
    settled = (model for model in fits if model is not None)
    return min(settled, key=lambda model: cost(search, model), default=None)


def required_evidence(search: Search, spectrum: SpectrumModel, i: int) -> float:
    """Return what component i must add to the logarithm of the likelihood.

    Less for a drift, which has two parameters; more for a bump, which has the number of its
    sections beside three. Of many data these are small beside what a bump of the wrong shape lacks:
    a component upon one must lower the variance of the innovations by a part that shows.
    """
    component = spectrum.components[i]
    parameters = PARAMETERS + (component.sections > 1) - (component.kind == "drift")
    price = parameters * search.parameter_price
    bumps = [c for k, c in enumerate(spectrum.components) if c.sections > 1 and k != i]
    away = (abs(component.log_frequency - c.log_frequency) / c.damping_ratio for c in bumps)
    if component.kind != "line" or min(away, default=_FAR) >= _FAR:
        return price
    return max(price, _WORTH * float(np.sum(search.data.count)))


def total_price(search: Search, spectrum: SpectrumModel) -> float:
    """Return the price of all that a model has beside its turbulence."""
    prices = sum(required_evidence(search, spectrum, i) for i in range(1, len(spectrum.components)))
    background = spectrum.background
    colour = _COLOURED if background.colour else 0.0
    return prices + colour + background.rolls_off * search.parameter_price


def cost(search: Search, model: FittedModel) -> float:
    """Return the contrast of a model, with the prior of its gain, plus the price of all it has."""
    log_gain = model.spectrum.background.log_gain
    away = float(log_gain - np.log(TYPICAL_GAIN)) / search.gain_error * search.finds_gain
    return model.contrast + total_price(search, model.spectrum) + 0.5 * away**2


def simplify(search: Search, model: FittedModel) -> FittedModel:
    """Return the model without roll-off or colour, where that adds too little."""
    plainer = []
    if model.spectrum.background.rolls_off:
        plainer.append(model.spectrum.without_roll_off())
    if model.spectrum.background.colour:
        plainer.append(model.spectrum.with_background(colour=0.0))
    fits = (fit(search, spectrum) for spectrum in plainer)
    return likeliest(search, [model, *fits]) or model


def prune(search: Search, model: FittedModel, *, thorough: bool = False) -> FittedModel:
    """Drop the components that add less than they must, the least first.

    Others may take over what a wide one explains, or one that overlaps another, but only after a
    long fit: ``thorough`` makes it.
    """
    trials, spectrum = [], model.spectrum
    data = search.merge(spectrum)
    least = contrast(data, spectrum)
    for i, component in enumerate(spectrum.components):
        neighbour = _overlapping(search, spectrum, i)
        smaller = _drop(data, spectrum, i, neighbour)
        if smaller is not None:
            required = required_evidence(search, spectrum, i)
            spare = contrast(data, smaller) - least - HOPE * required
            patient = thorough and (neighbour is not None or not component.is_narrow)
            if patient or spare <= 0:
                trials.append((spare, required, smaller, None if patient else model))
    for _, required, smaller, bound in sorted(trials, key=lambda trial: trial[0]):
        plainer = fit(search, smaller, better_than=bound, margin=required)
        if plainer is not None and cost(search, plainer) < cost(search, model):
            return prune(search, plainer, thorough=thorough)
    return model


def _overlapping(search: Search, spectrum: SpectrumModel, i: int) -> int | None:
    """Return the nearest line that is within two half widths of the narrower one, or None."""
    if spectrum.components[i].kind != "line":
        return None
    centre, half = search.place(spectrum.components[i])
    apart = {}
    for k, rival in enumerate(spectrum.components):
        its_centre, its_half = search.place(rival)
        if k != i and rival.kind == "line" and abs(its_centre - centre) < 2 * min(half, its_half):
            apart[k] = abs(its_centre - centre)
    return min(apart, key=apart.__getitem__, default=None)


def _drop(
    data: LoopPeriodogram, spectrum: SpectrumModel, i: int, neighbour: int | None
) -> SpectrumModel | None:
    """Return the model without a component, whose power a neighbour takes; None for turbulence."""
    if i == 0:
        return None
    if neighbour is not None:
        line = spectrum.components[neighbour]
        power = float(np.logaddexp(line.log_power, spectrum.components[i].log_power))
        return spectrum.exchange(neighbour, replace(line, log_power=power)).exchange(i)
    smaller, noise = spectrum.exchange(i), float(np.exp(spectrum.background.log_noise))
    alone = part_densities(data, spectrum, spectrum.components[i : i + 1])
    white = float(np.min(alone)) * data.frame_rate_hz / 2
    if white > noise:  # a wide component may have taken the place of the noise
        return smaller.with_background(log_noise=float(np.log(noise + white)))
    return smaller


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
    ends = centre - SKIRT * step, centre + SKIRT * step
    data = search.data.take(slice(*np.searchsorted(search.data.frequency_hz, ends)))
    rest = density(data, spectrum.exchange(i))
    for shifts in (_SHIFTS, _SHIFTS / 8):  # the place of a sinusoid is known to a part of a bin
        moves = product(np.log1p(shifts * step / centre), _POWERS)
        # the width stays
        trials = [line, *(line.shift(move, -move, power) for move, power in moves)]
        densities = rest + part_densities(data, spectrum, trials)
        best = int(np.argmin(contrasts(data, spectrum.background.gain, densities)))
        line = trials[best]
    return spectrum.exchange(i, line)
