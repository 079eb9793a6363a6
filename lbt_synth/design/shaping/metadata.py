"""Specifications as plain metadata, and back."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, get_args

import numpy as np

from lbt_synth.design.shaping.objectives import ResidualVariance, Total, VibrationBand, Worst
from lbt_synth.design.shaping.specification import Demand, Specification
from lbt_synth.models import ARModel, Atmosphere, TabulatedSpectrum

_KINDS: dict[str, type[Any]] = {
    kind.__name__: kind
    for kind in (
        *get_args(Demand),
        *(Specification, ResidualVariance, VibrationBand, Total, Worst),
        *(Atmosphere, ARModel, TabulatedSpectrum),
    )
}


def to_metadata(value: Any) -> Any:
    """Return a specification, or a part of it, as plain values for JSON."""
    name = type(value).__name__
    if name in _KINDS:
        named = {f.name: to_metadata(getattr(value, f.name)) for f in fields(value)}
        return {"kind": name, **named}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [to_metadata(v) for v in value]
    return value


def from_metadata(data: Any) -> Any:
    """Rebuild what :func:`to_metadata` wrote; an unknown kind raises KeyError."""
    if isinstance(data, dict):
        values = dict(data)
        kind = _KINDS[values.pop("kind")]
        return kind(**{key: from_metadata(v) for key, v in values.items()})
    if isinstance(data, list):
        return tuple(from_metadata(v) for v in data)
    return data
