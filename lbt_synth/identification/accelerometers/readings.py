"""Readings of accelerometers: from a file, averaged over the frames of a loop."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError, TelemetryError
from lbt_synth.identification.accelerometers.units import M_S2
from lbt_synth.identification.records.column_selection import CLOCKS
from lbt_synth.identification.records.contents import read_contents
from lbt_synth.validation import BoolArray, FloatArray, float_array

_MISSING = 0.1  # of the frames without a number, from which a channel counts as dead
_NAME = re.compile(r"\w[\w .+-]*$")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Readings:
    """Accelerations of some channels, one row per frame of a loop."""

    channels: tuple[str, ...]
    values: FloatArray  # (frames, channels) [m/s^2], NaN where one is missing

    def beside(self, frames: int) -> FloatArray:
        """Return them beside a record of so many frames, NaN beyond their end."""
        out = np.full((frames, len(self.channels)), np.nan)
        both = min(frames, len(self.values))
        out[:both] = self.values[:both]
        return out


def load_readings(
    path: str | os.PathLike[str],
    frame_rate_hz: float,
    *,
    rate_hz: float | None = None,
    unit: str = "m/s2",
) -> Readings:
    """Read accelerations from a file of any format that records have, one column per channel.

    Readings at a whole multiple of the frame rate are averaged.
    """
    source = Path(path)
    found = [each for each in read_contents(source).columns if each.role not in CLOCKS]
    sizes = sorted({each.values.size for each in found})
    if len(sizes) != 1:
        raise TelemetryError(
            f"{source} must hold columns of one length, a sensor each; got {len(found)} of "
            f"{sizes} rows.",
            path=source,
        )
    names = [each.name.strip() for each in found]
    if not all(_NAME.match(name) for name in names) or len(set(names)) < len(names):
        names = [f"channel{c + 1}" for c in range(len(found))]
    values = M_S2[unit] * np.stack([each.values for each in found], axis=1)
    ratio = 1.0 if rate_hz is None else rate_hz / frame_rate_hz
    many = round(ratio)
    if many < 1 or abs(ratio - many) > 1e-6 * ratio:
        raise ProblemError(
            f"the rate of the accelerometers must be a whole multiple of the frame rate, "
            f"{frame_rate_hz:g} Hz; got {rate_hz:g} Hz, {ratio:.6g} times. Resample them first."
        )
    whole = values[: len(values) // many * many].reshape(-1, many, len(names))
    return Readings(channels=tuple(names), values=whole.mean(axis=1))


def fill_missing(accelerations: ArrayLike) -> tuple[FloatArray, BoolArray]:
    """Return readings (frames, channels) with zeros in gaps, and the frames without one.

    A channel that misses more than a tenth of the frames becomes zeros, and spoils no frame.
    """
    given = float_array(accelerations, "accelerations")
    given = given[:, None] if given.ndim == 1 else given
    if given.ndim != 2 or given.size == 0:
        raise DimensionError(f"accelerations must be (frames, channels); got {given.shape}.")
    good = np.isfinite(given)
    fine = np.mean(good, axis=0) >= 1 - _MISSING
    if not fine.any():  # one that ends early may be whole until then
        fine = good.any(axis=0)
    return np.where(good & fine, given, 0.0), np.asarray(good[:, fine].all(axis=1))
