"""Limits that cannot always be computed, and how far a residual is above one."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from lbt_synth.errors import LbtSynthError

if TYPE_CHECKING:
    from lbt_synth.loop.least_residuals.band_limit import BandLimit
    from lbt_synth.loop.least_residuals.residual_limit import ResidualLimit

T = TypeVar("T")


def above_percent(rms_nm: float, limit_nm: float) -> float:
    """Return how far a residual is above a limit [%]; nan where the limit is 0 or nan."""
    return 100 * (rms_nm / limit_nm - 1) if limit_nm > 0 else np.nan


def limit_or_nan(limit: Callable[[], ResidualLimit | BandLimit]) -> float:
    """Return the least residual [nm rms], nan where it cannot be computed."""
    found = limit_or_none(limit)
    return np.nan if found is None else found.rms_nm


def limit_or_none(limit: Callable[[], T]) -> T | None:
    """Return the limit, None where it cannot be computed."""
    try:
        return limit()
    except LbtSynthError:
        return None
