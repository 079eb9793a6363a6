"""The least residual of any linear controller under the spectra that a shaped design was given."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lbt_synth.design.model_limits import above_percent, limit_or_nan
from lbt_synth.design.shaping.channel import mode_loop
from lbt_synth.design.shaping.objectives import ResidualVariance, VibrationBand, leaves
from lbt_synth.loop import BandLimit, ResidualLimit, least_residual, least_worst_residual
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.models.spectra import SumSpectrum

if TYPE_CHECKING:
    from lbt_synth.design.loop_shaping import ShapedDesign


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
        if not variances or len(bands) > 1:
            return np.nan, np.nan
        hardware = design.loop_hardware.single_mode()
        spectra = [each.turbulence for each in variances if each.turbulence is not None]
        truth = Truth(
            turbulence=SumSpectrum(parts=tuple(spectra)) if spectra else None,
            noise_nm=float(np.linalg.norm([each.noise_nm for each in variances])),
        )
        found = limit_or_nan(partial(_mode_limit, hardware, truth, bands))
        loop = mode_loop(design.loop_hardware, parameter)
        limit_nm2 += found**2
        residual_nm2 += sum(variance.measured_nm2(loop) for variance in variances)
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
