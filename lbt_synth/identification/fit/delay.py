"""Another delay that fits a record better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.identification.fit.model_fitter import ModelFitter, Rules
from lbt_synth.identification.fit.parameters import FittedModel
from lbt_synth.identification.fit.periodogram import (
    SHORTEST_SEGMENT,
    LoopPeriodogram,
    loop_periodogram,
)
from lbt_synth.identification.fit.physical_parameters import WIDE_DAMPING
from lbt_synth.identification.fit.whittle import GAIN, NOISE
from lbt_synth.identification.records.record import LoopRecord

_SHIFTS = (-1.0, -0.5, 0.5, 1.0)  # frames by which the delay is changed
_HIGH = 0.6  # of the highest frequency
_CLEARLY = 5.0  # by which the criterion of another delay must be better


def better_delay(
    record: LoopRecord, i: int, axis: IdentifiedAxis, stretches: Sequence[tuple[int, int]]
) -> tuple[float, float] | None:
    """Return the delay at which axis i is modelled clearly better, and the gain of the criterion.

    None if there is no such delay. A wrong delay looks like wide resonances: they are left out
    where another delay is tried.
    """
    assert record.delay_frames is not None
    later = [(a + 2, b) for a, b in stretches if b - a > 2 * SHORTEST_SEGMENT]
    if not later:
        return None
    # the model keeps its parts; its gain is free
    rules = Rules(gain=None, lowest_line_hz=0.0, most_lines=0)
    simple = axis.fitted_model.drop_wide(WIDE_DAMPING)
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
        fitter = ModelFitter(data, rules)
        again = fitter.refit(_set_noise(simple, data) if shift else axis.fitted_model)
        if again is not None:
            found[delay] = again.contrast + fitter.price * len(again.parts)
    here = found.pop(record.delay_frames, None)
    if here is None or not found:
        return None
    best = min(found, key=lambda delay: found[delay])
    more = here - found[best]
    return (best, more) if more > _CLEARLY else None


def _set_noise(model: FittedModel, data: LoopPeriodogram) -> FittedModel:
    """Return the model with the noise that the highest frequencies show."""
    theta = model.theta.copy()
    high = data.frequency_hz > _HIGH * data.frequency_hz[-1]
    density = float(np.median(data.power(float(np.exp(theta[GAIN])))[high]))
    theta[NOISE] = np.log(density * data.frame_rate_hz / 2)
    return replace(model, minimum=replace(model.minimum, parameters=theta))
