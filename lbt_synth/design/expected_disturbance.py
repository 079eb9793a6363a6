"""What a design expects of the disturbance: the variance of its model, or its specification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lbt_synth.linear import EstimationProblem, StateSpace
from lbt_synth.loop.least_residuals.mode_spectra import ResponseSpectrum
from lbt_synth.models import FullStatePlant, Spectrum, TipTiltPlant

if TYPE_CHECKING:
    from lbt_synth.design.shaping import VibrationBand


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModeDisturbance:
    """What a design expects on one mode."""

    spectrum: Spectrum | None
    bands: tuple[VibrationBand, ...] = ()  # in which a vibration may be anywhere


def modelled_disturbance(problem: EstimationProblem) -> tuple[ModeDisturbance, ...] | None:
    """Return what a plant has on each mode; None for a bare estimation problem."""
    if not isinstance(problem, TipTiltPlant | FullStatePlant):
        return None
    D = np.zeros((len(problem.L), problem.B.shape[1]))
    phase = StateSpace(A=problem.A, B=problem.B, C=problem.L, D=D, dt_s=problem.dt_s)
    return tuple(
        ModeDisturbance(spectrum=ResponseSpectrum(phase, axis)) for axis in np.eye(len(problem.L))
    )
