"""The disturbance that a design was made for: a spectrum of each mode, and bands of vibrations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.design.loop_shaping import ShapedDesign
from lbt_synth.design.result import Design, EstimatorDesign
from lbt_synth.design.shaping import VibrationBand
from lbt_synth.design.shaping.objectives import leaves
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.linear import StateSpace
from lbt_synth.loop.least_residuals.mode_spectra import ResponseSpectrum
from lbt_synth.models import FullStatePlant, Spectrum, TipTiltPlant
from lbt_synth.models.spectra import SumSpectrum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModeDisturbance:
    """What a design expects on one mode."""

    spectrum: Spectrum | None
    bands: tuple[VibrationBand, ...] = ()  # in which a vibration may be anywhere


def expected_disturbance(design: Design) -> tuple[ModeDisturbance, ...] | None:
    """Return what a design expects on each mode; None if it was made for no disturbance."""
    if isinstance(design, ShapedDesign):
        return tuple(map(_specified, design.specifications))
    if not isinstance(design, EstimatorDesign):
        return None
    plant = design.problem
    if not isinstance(plant, TipTiltPlant | FullStatePlant):
        return None
    D = np.zeros((len(plant.L), plant.B.shape[1]))
    phase = StateSpace(A=plant.A, B=plant.B, C=plant.L, D=D, dt_s=plant.dt_s)
    return tuple(
        ModeDisturbance(spectrum=ResponseSpectrum(phase, axis)) for axis in np.eye(len(plant.L))
    )


def _specified(specification: Specification) -> ModeDisturbance:
    """Return what a specification names, at the first of its sensor gains."""
    every = leaves(specification.objective)
    parts = [part for part in every if part.sensor_gain == every[0].sensor_gain]
    bands = tuple(part for part in parts if isinstance(part, VibrationBand))
    found = [part.skirts if isinstance(part, VibrationBand) else part.turbulence for part in parts]
    spectra = tuple(spectrum for spectrum in found if spectrum is not None)
    return ModeDisturbance(spectrum=SumSpectrum(parts=spectra) if spectra else None, bands=bands)
