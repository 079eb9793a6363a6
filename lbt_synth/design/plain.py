"""Models and specifications as plain values for JSON, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any

import numpy as np

_MODELS = (
    *("ARModel", "Atmosphere", "TabulatedSpectrum", "Vibration", "Motion", "PositionLoop"),
    *("WavefrontSensor", "Accelerometer"),
)
_SHAPING = (
    *("Specification", "ResidualVariance", "VibrationBand", "Bound", "CommandRms", "LoopErrors"),
)
_ROOMS = dict.fromkeys(_MODELS, "lbt_synth.models")
_ROOMS |= dict.fromkeys(_SHAPING, "lbt_synth.design.shaping")


def to_plain(value: Any) -> Any:
    """Return plain values: an object has the name of its class as its kind, beside its fields."""
    if is_dataclass(value):
        named = {f.name: to_plain(getattr(value, f.name)) for f in fields(value) if f.init}
        return {"kind": type(value).__name__, **named}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: to_plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(part) for part in value]
    return value


def from_plain(data: Any) -> Any:
    """Rebuild what :func:`to_plain` wrote; an unknown kind raises KeyError."""
    if isinstance(data, dict):
        values = {key: from_plain(part) for key, part in data.items() if key != "kind"}
        if "kind" not in data:
            return values
        return getattr(import_module(_ROOMS[data["kind"]]), data["kind"])(**values)
    if isinstance(data, list):
        return tuple(from_plain(part) for part in data)
    return data
