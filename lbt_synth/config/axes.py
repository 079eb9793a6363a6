"""Axes and measurements of a configuration: their numbers, and checks of values per axis."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from lbt_synth.config.schema import FileSection, TrueVibrationSection, VibrationSection
from lbt_synth.errors import ConfigError

T = TypeVar("T")


def count_axes(settings: FileSection) -> int:
    """Return the number of modes n: ``loop.axes``, else that of the matrices, else 2."""
    sensor, influence = settings.sensor.matrix, settings.mirror.influence_matrix
    sizes = [
        *([("sensor.matrix", "columns", len(sensor[0]))] if sensor else []),
        *([("mirror.influence_matrix", "rows", len(influence))] if influence else []),
    ]
    axes = settings.loop.axes
    if axes is None:
        return sizes[0][2] if sizes else 2
    for key, word, size in sizes:
        if size != axes:
            raise ConfigError(
                f"{key} must have {axes} {word} to match loop.axes; got {size}.", path=key
            )
    return axes


def count_measurements(settings: FileSection) -> int:
    """Return the number of measurements q: rows of ``sensor.matrix``, else one per axis."""
    sensor = settings.sensor.matrix
    return len(sensor) if sensor else count_axes(settings)


def require_length(values: list[T], count: int, key: str, what: str) -> list[T]:
    """Return a list that must have one value for each of ``count`` axes or measurements."""
    if len(values) != count:
        raise ConfigError(
            f"{key}: must be one for all, or a list of one per {what} ({count}); got "
            f"{len(values)}.",
            path=key,
        )
    return values


def vibration_directions(
    section: VibrationSection | TrueVibrationSection, axes: int, key: str
) -> list[tuple[float, ...]]:
    """Return the directions of the vibrations that one entry of a list describes."""
    if axes == 1:
        if section.axis in ("tilt", "both") or section.direction_deg is not None:
            raise ConfigError(
                f"{key}: this loop has one axis: leave axis and direction_deg out.", path=key
            )
        return [(1.0,)]
    if section.direction_deg is not None:
        angle = np.radians(section.direction_deg)
        return [(float(np.cos(angle)), float(np.sin(angle)))]
    if section.axis is None:
        raise ConfigError(f"{key}: expected exactly one of axis, direction_deg.", path=key)
    known = {"tip": [(1.0, 0.0)], "tilt": [(0.0, 1.0)], "both": [(1.0, 0.0), (0.0, 1.0)]}
    return [tuple(direction) for direction in known[section.axis]]
