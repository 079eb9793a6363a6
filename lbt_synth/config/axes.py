"""The axes of a configuration: how many, and what is given once or for each of them."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from lbt_synth.config.schema import FileSection, TrueVibrationSection, VibrationSection
from lbt_synth.errors import ConfigError

T = TypeVar("T")


def axes_of(settings: FileSection) -> int:
    """Return the number of modes n: of ``loop.axes``, else of the matrices, else 2."""
    sensor, influence = settings.sensor.matrix, settings.mirror.influence_matrix
    sizes = [
        *([("sensor.matrix", "columns", len(sensor[0]))] if sensor else []),
        *([("mirror.influence_matrix", "rows", len(influence))] if influence else []),
    ]
    asked = settings.loop.axes
    if asked is None:
        return sizes[0][2] if sizes else 2
    for key, word, size in sizes:
        if size != asked:
            raise ConfigError(
                f"{key} must have {asked} {word}, as loop.axes says; got {size}.", path=key
            )
    return asked


def measurements_of(settings: FileSection) -> int:
    """Return the number of measurements q: rows of ``sensor.matrix``, else one an axis."""
    sensor = settings.sensor.matrix
    return len(sensor) if sensor else axes_of(settings)


def fitted(values: list[T], count: int, key: str, what: str) -> list[T]:
    """Return a list that has one value for each of ``count`` axes or measurements."""
    if len(values) != count:
        raise ConfigError(
            f"{key}: must be one for all, or a list of one {what} ({count}); got {len(values)}.",
            path=key,
        )
    return values


def directions_of(
    section: VibrationSection | TrueVibrationSection, axes: int, key: str
) -> list[tuple[float, ...]]:
    """Return the directions of the vibrations that one entry of a list makes."""
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
