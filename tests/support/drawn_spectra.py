"""Random periodograms of a minute, of a known spectrum over white noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import Background, SpectrumModel
from lbt_synth.identification.fit.whittle import density

NOISE = 30.0  # variance [nm^2]


def empty_search() -> Search:
    """Return the search in a periodogram of 1 kHz without anything in it."""
    f = np.arange(1, 30_000) / 60.0
    zero = np.zeros_like(f)
    data = LoopPeriodogram(
        frequency_hz=f,
        measured=zero + 1.0,
        crossed=zero,
        corrected=zero,
        count=zero + 1.0,
        frame_rate_hz=1000.0,
    )
    return Search(data=data, gain=1.0)


def white_noise() -> SpectrumModel:
    """Return noise alone, without a roll-off."""
    background = Background(0.0, float(np.log(NOISE)), 0.0, 0.0)
    return SpectrumModel((background,), ()).without_roll_off()


def drawn_search(truth: SpectrumModel, seed: int) -> Search:
    """Return the search in a random periodogram of a spectrum."""
    search = empty_search()
    chance = np.random.default_rng(seed).exponential(size=search.data.frequency_hz.size)
    data = replace(search.data, measured=density(search.data, truth) * chance)
    return replace(search, data=data)
