"""The background of a spectrum beside its lines: turbulence over white noise.

It is fitted to medians over bands, which narrow lines hardly touch; wide ones are held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from lbt_synth.identification.fit import fitting
from lbt_synth.identification.fit.fitting import GAINS, Search
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.scoring import SEARCHED
from lbt_synth.identification.fit.spectrum_model import Component, SpectrumModel
from lbt_synth.identification.fit.whittle import FittedModel, contrast, density, minimise

_TURBULENCE = ((0.5, 0.55), (5.0, 0.55))  # frequency [Hz] and damping ratio where a fit begins
_DRIFT = (2.0, 30.0)  # the same of a first-order process
_CROSSINGS_HZ = (1.0, 3.0, 10.0, 30.0, 100.0)  # where a drift beside turbulence may meet the noise
_SHARES = (1.0, 0.1)  # of the slow variance in that turbulence
_MOST_DRIFTS = 2  # fits of both
_BANDS = 80
_GAINS = (2 * GAINS["above"], GAINS["below"] / 2)


def fit_background(
    search: Search, gain: float, lines: Sequence[Component] = (), *, drifts: bool = False
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
    ground = SpectrumModel(float(np.log(gain)), float(np.log(white)), search.colour, corner, ())
    held = density(smooth, ground.alone(*lines))
    slow = max(float(np.trapezoid(np.maximum(d - held, 0), f)) - white, 0.1 * white)
    if drifts:
        starts = _starting_drifts(known, ground, slow, 2 * white / rate)
        starts = sorted(starts, key=lambda start: contrast(smooth, start, held))[:_MOST_DRIFTS]
    else:
        places = (*_TURBULENCE, _DRIFT)
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
    hz, ratio = _DRIFT
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
