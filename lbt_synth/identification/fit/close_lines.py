"""Lines that may be several, closer to each other than the record can separate.

The sum of two resonances within some half widths has nearly the spectrum of one, and the fit gives
one: at the mean of their frequencies, with the sum of their power. Its standard errors hold for
these. Here each line becomes two of like damping, and what that adds to the likelihood decides.
Below some separation it adds too little, and nobody can know.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lbt_synth.identification.fit.fitting import Search, close_line
from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.identification.fit.scoring import SEARCHED, Priors
from lbt_synth.identification.fit.spectrum_model import SpectrumModel
from lbt_synth.identification.fit.whittle import contrast, density, minimise

_LIKELY = 5.5  # log-likelihood that a split rarely adds to a single line
_WEAK = 40.0  # the same of a line in the skirts of another whose errors are too small
_SHARES = (0.5, 0.8, 0.2)  # of the power in the lower line, where a fit begins
_APART = 1.4  # half widths between the lines there
_NARROWER = -0.25  # of the logarithm of the damping
_LIKE = 0.5  # width of the prior around that
_REACH = 20.0  # half widths around a line that are fitted
_TRIPLE = 3  # parameters of a component, the last in a packed vector
_NEAR = 0.2  # of the logarithm of what a pair adds, where a separation is near enough
_MOST_STEPS = 8
_STEEPNESS = 4.0  # of what a pair adds with its separation, where nothing is known


def describe_close_lines(axis: IdentifiedAxis, name: int) -> Iterator[str]:
    """Yield notes on lines that may be several, and on lines that are hardly separate."""
    search, model = Search(data=axis.data), axis.fitted_model
    spectrum = model.spectrum
    lines = [i for i, c in enumerate(spectrum.components) if c.is_narrow]
    for i in lines:
        place = (
            f"warning: the line of axis {name} at {search.place(spectrum.components[i])[0]:.4g} Hz"
        )
        if split_gain(search, spectrum, i, worth=_LIKELY) > _LIKELY:
            yield (
                f"{place} may be two, closer than the record separates: its errors hold for the "
                "mean of their frequencies and for their power together"
            )
        elif model.evidence[i] < _WEAK and close_line(search, spectrum, i) is not None:
            yield f"{place} lies in the skirts of another: the errors of both may be too small"


def split_gain(search: Search, spectrum: SpectrumModel, i: int, *, worth: float = 0.0) -> float:
    """Return what two lines of like damping in the place of line i add to the log-likelihood.

    Nothing beside zero frequency, where there is no place for two. Fits that will hardly add what
    is worth it are given up.
    """
    line = spectrum.components[i]
    centre, half = search.place(line)
    if centre < 2 * half:
        return 0.0
    data = search.merge(spectrum).window(centre - _REACH * half, centre + _REACH * half)
    single, rest = contrast(data, spectrum), density(data, spectrum.exchange(i))
    best = single
    for share in _SHARES:
        lower, upper = (
            line.shift(float(np.log1p(move * half / centre)), _NARROWER, float(np.log(power)))
            for move, power in ((-_APART * (1 - share), share), (_APART * share, 1 - share))
        )
        start = spectrum.alone(lower, replace(upper, announced=None))
        width = np.zeros(start.pack().size)
        width[-2 * _TRIPLE :] = 2 * (np.inf, _LIKE, np.inf)
        priors = Priors(centre=start.pack(), width=width)
        found = minimise(data, start, priors, held=rest, bound=best - worth, accuracy=SEARCHED)
        if found is not None:
            away = (found.spectrum.pack() - priors.centre)[[1 - 2 * _TRIPLE, 1 - _TRIPLE]]
            best = min(best, found.contrast + float(np.sum((away / _LIKE) ** 2)) / 2)
    return single - best


def measure_separations(axis: IdentifiedAxis) -> IdentifiedAxis:
    """Return an axis each of whose lines knows how far apart two like it have to be."""
    search, spectrum = Search(data=axis.data), axis.fitted_model.spectrum
    centres = np.array([search.place(c)[0] for c in spectrum.components[1:]])
    parts = list(axis.parts)
    for k, part in enumerate(parts):
        if part.kind == "line":
            i = 1 + int(np.argmin(np.abs(centres - part.frequency_hz)))
            parts[k] = replace(part, separable_hz=separable_hz(search, spectrum, i))
    return replace(axis, parts=tuple(parts))


def separable_hz(search: Search, spectrum: SpectrumModel, i: int) -> float:
    """Return how far apart two like lines have to be to be seen as two in the place of line i.

    There the likelihood expects as much of a pair as a split rarely adds to a single line [Hz]. At
    most some half widths: beyond, a line is hardly seen.
    """
    line = spectrum.components[i]
    centre, half = search.place(line)
    data = search.merge(spectrum).window(centre - _REACH * half, centre + _REACH * half)
    rest, zero = density(data, spectrum.exchange(i)), np.zeros_like(data.measured)
    data = replace(data, measured=density(data, spectrum), crossed=zero, corrected=zero)
    single = contrast(data, spectrum)
    start = spectrum.alone(*(line.shift(0.0, _NARROWER, float(np.log(0.5))) for _ in range(2)))
    places = start.pack().size - _TRIPLE * np.array([2, 1])
    width = np.zeros(start.pack().size)
    width[-2 * _TRIPLE :] = 2 * (0.0, np.inf, np.inf)
    most = min(centre, _REACH * half)
    apart, known = min(3 * half, most), []
    for _ in range(_MOST_STEPS):
        theta = start.pack()
        theta[places] = line.log_frequency + np.log1p(np.array([-0.5, 0.5]) * apart / centre)
        at = start.unpack(theta)
        found = minimise(data, at, Priors(centre=theta, width=width), held=rest, accuracy=SEARCHED)
        if found is None:
            break
        start = found.spectrum
        known.append((np.log(apart), np.log(max(found.contrast - single, 1e-9) / _LIKELY)))
        if abs(known[-1][1]) < _NEAR or (apart == most and known[-1][1] < 0):
            break
        slope = _STEEPNESS
        if len(known) > 1:
            run, rise = np.subtract(known[-1], known[-2])
            slope = max(rise / run, 1.0)
        apart = min(apart * float(np.exp(np.clip(-known[-1][1] / slope, -1, 1))), most)
    return apart
