"""Another delay that fits a record better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.identification.fit.fitting import Search, refit
from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.identification.fit.parameters import SpectrumModel
from lbt_synth.identification.fit.periodogram import (
    SHORTEST_SEGMENT,
    LoopPeriodogram,
    loop_periodogram,
)
from lbt_synth.identification.fit.physical_parameters import WIDE_DAMPING
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches

_SHIFTS = (-1.0, -0.5, 0.5, 1.0)  # frames by which the delay is changed
_HIGH = 0.6  # of the highest frequency
_CLEARLY = 5.0  # by which the criterion of another delay must be better


def better_delay(
    record: LoopRecord, i: int, axis: IdentifiedAxis, stretches: Stretches
) -> tuple[float, float] | None:
    """Return the delay at which axis i is modelled clearly better, and the gain of the criterion.

    None if there is no such delay. A wrong delay looks like wide resonances: they are left out
    where another delay is tried.
    """
    assert record.delay_frames is not None
    later = [(a + 2, b) for a, b in stretches if b - a > 2 * SHORTEST_SEGMENT]
    if not later:
        return None
    simple = axis.fitted_model.spectrum.drop_wide(WIDE_DAMPING)
    found: dict[float, float] = {}
    for shift in (0.0, *_SHIFTS):
        delay = record.delay_frames + shift
        if delay < 1:
            continue
        shifted = record.with_delay(delay, mirror=record.mirror)
        data = loop_periodogram(
            record.measurements[:, i],
            shifted.corrections()[:, i],
            frame_rate_hz=record.frame_rate_hz,
            stretches=later,
        )
        # the model keeps its parts; its gain is free
        search = Search(data=data, lowest_line_hz=0.0)
        start = _set_noise(simple, data) if shift else axis.fitted_model.spectrum
        model = refit(search, start)
        if model is not None:
            count = len(model.spectrum.components)
            found[delay] = model.contrast + search.price * count
    here = found.pop(record.delay_frames, None)
    if here is None or not found:
        return None
    best = min(found, key=lambda delay: found[delay])
    more = here - found[best]
    return (best, more) if more > _CLEARLY else None


def _set_noise(spectrum: SpectrumModel, data: LoopPeriodogram) -> SpectrumModel:
    """Return the model with the noise that the highest frequencies show."""
    high = data.frequency_hz > _HIGH * data.frequency_hz[-1]
    density = float(np.median(data.power(spectrum.gain)[high]))
    return replace(spectrum, log_noise=float(np.log(density * data.frame_rate_hz / 2)))
