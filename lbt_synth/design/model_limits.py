"""The least residual that a design's own model allows, and how far the design is above it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from lbt_synth.design.loop_shaping import ShapedDesign
from lbt_synth.design.result import EstimatorDesign
from lbt_synth.design.shaping import ResidualVariance, VibrationBand
from lbt_synth.design.shaping.channel import mode_loop
from lbt_synth.design.shaping.objectives import leaves
from lbt_synth.errors import LbtSynthError
from lbt_synth.loop import (
    BandLimit,
    ResidualLimit,
    close_loop,
    least_residual,
    least_worst_residual,
    model_budget,
)
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
from lbt_synth.models import FullStatePlant, LoopHardware, TipTiltPlant, Truth

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


def shaped_limit(design: ShapedDesign) -> tuple[float, float]:
    """Return the limit of a shaped design's own spectra [nm rms], and its residual above it [%].

    Both are over all modes at unit sensor gain: the variance plus the worst of the band. They
    are nan where a mode has no variance at unit gain, or several bands, as the limit of their
    sum is not known.
    """
    limit_nm2, residual_nm2 = 0.0, 0.0
    for spec, parameter in zip(design.specifications, design.parameters, strict=True):
        at_unit = [leaf for leaf in leaves(spec.objective) if leaf.sensor_gain == 1]
        variances = [leaf for leaf in at_unit if isinstance(leaf, ResidualVariance)]
        bands = [leaf for leaf in at_unit if isinstance(leaf, VibrationBand)]
        if len(variances) != 1 or len(bands) > 1:
            return np.nan, np.nan
        hardware = design.loop_hardware.single_mode()
        truth = Truth(turbulence=variances[0].turbulence, noise_nm=variances[0].noise_nm)
        found = limit_or_nan(partial(_mode_limit, hardware, truth, bands))
        loop = mode_loop(design.loop_hardware, parameter)
        limit_nm2 += found**2
        residual_nm2 += variances[0].measured_nm2(loop)
        residual_nm2 += sum(band.measured_nm2(loop) for band in bands)
    limit_nm = float(np.sqrt(limit_nm2))
    return limit_nm, above_percent(float(np.sqrt(residual_nm2)), limit_nm)


def _mode_limit(
    hardware: LoopHardware, truth: Truth, bands: list[VibrationBand]
) -> ResidualLimit | BandLimit:
    if not bands:
        return least_residual(hardware, truth)
    return least_worst_residual(
        hardware,
        truth,
        band_hz=(bands[0].low_hz, bands[0].high_hz),
        rms_nm=bands[0].rms_nm,
        direction=(1.0,),
    )
