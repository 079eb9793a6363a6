"""The model of a record at the likelier of two sensor gains, where the fit has several optima."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.identification.fit.both_axes import identify
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import FloatArray

_OUTSIDE = 1.3  # factor beyond an interval of gains


def identify_likeliest(
    record: LoopRecord, *, allowed: FloatArray | None, **options: Any
) -> IdentifiedModel:
    """Identify a record, from other sensor gains as well if the first is one that it excludes.

    Wide resonances may carry a fit to a gain far from the true one, where the likelihood has
    another optimum.

    Parameters
    ----------
    record : LoopRecord
        The record.
    allowed : (axes, 2) ndarray or None
        Intervals of :func:`allowed_gains`; None for an open loop, or a gain that is given.
    **options
        Those of :func:`identify`.

    Returns
    -------
    IdentifiedModel
        The likelier model by the criterion of the fit, with a note if it is not the first.

    Raises
    ------
    ProblemError, NumericalError
        As :func:`identify`.
    """
    model = identify(record, **options)
    if allowed is None or options.get("sensor_gain") is not None or agrees(model, allowed):
        return model
    begun = options | {"sensor_gain": np.sqrt(np.prod(allowed, axis=1)).tolist(), "start": None}
    other = identify(record, **options | {"start": identify(record, **begun)})
    return other if _criterion(other) < _criterion(model) else model


def agrees(model: IdentifiedModel, allowed: FloatArray) -> bool:
    """Return whether the sensor gains of a model are near those that a record allows."""
    gains = np.array(model.sensor_gains)
    near = (gains > allowed[:, 0] / _OUTSIDE) & (gains < allowed[:, 1] * _OUTSIDE)
    return bool(near.all())


def _criterion(model: IdentifiedModel) -> float:
    """Return minus the logarithm of the likelihood plus the price of all components."""
    total = 0.0
    for axis in model.axes:
        fitted, count = axis.fitted_model, float(np.sum(axis.data.count))
        price = 0.5 * PARAMETERS * np.log(count)
        total += fitted.contrast + price * len(fitted.spectrum.components)
    return float(total)
