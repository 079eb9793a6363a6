"""The least residual that a design's own model allows, and how far the design is above it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from lbt_synth.errors import LbtSynthError
from lbt_synth.loop import close_loop, model_budget
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
from lbt_synth.models import FullStatePlant, TipTiltPlant

if TYPE_CHECKING:
    from lbt_synth.design.result import EstimatorDesign
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


def model_limit(design: EstimatorDesign) -> tuple[float, float, float]:
    """Return a filter's residual in its own model, the limit there [nm rms], and how far above [%].

    What cannot be computed is nan. The residual is the estimation error where the mirror reaches
    every command at once, or the design commands for its dynamics.
    """
    plant = design.problem
    if not isinstance(plant, TipTiltPlant | FullStatePlant):
        return np.nan, np.nan, np.nan
    hardware, residual_nm = plant.hardware, design.rms
    settled = hardware.delay_frames % 1 == 0 and hardware.mirror is None
    if not (settled or design.knows_mirror):
        residual_nm = np.nan
        if isinstance(plant, TipTiltPlant):
            loop = close_loop(hardware, design.controller)
            residual_nm = model_budget(loop, plant).rms_nm if loop.is_stable else np.nan
    limit_nm = limit_or_nan(lambda: least_model_residual(plant))
    return residual_nm, limit_nm, above_percent(residual_nm, limit_nm)
