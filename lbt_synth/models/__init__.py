"""Models of turbulence, vibration, sensor, mirror, and the plant made of them."""

from lbt_synth.models.ar import ARModel
from lbt_synth.models.atmosphere import Atmosphere
from lbt_synth.models.drift import DriftingVibration
from lbt_synth.models.flows import FrozenFlows
from lbt_synth.models.full_plant import FullStatePlant
from lbt_synth.models.hardware import LoopHardware
from lbt_synth.models.local_loop import PositionLoop, StepResponse
from lbt_synth.models.modal_turbulence import ModalTurbulence, modal_turbulence
from lbt_synth.models.plant import TipTiltPlant, retuned_plant, tip_tilt_plant
from lbt_synth.models.prior import spread_plant
from lbt_synth.models.problem import EstimationProblem
from lbt_synth.models.sensor import (
    illuminated_subapertures,
    pyramid_modal_noise_nm,
    pyramid_tilt_noise_nm,
)
from lbt_synth.models.truth import (
    SinusoidalVibration,
    Spectrum,
    SumSpectrum,
    TabulatedSpectrum,
    Truth,
)
from lbt_synth.models.turbulence import ar1_turbulence, ar2_turbulence, le_roux_pole
from lbt_synth.models.units import nm_per_mas
from lbt_synth.models.vibration import Vibration
from lbt_synth.models.zernike import noll_orders

__all__ = [
    "ARModel",
    "Atmosphere",
    "DriftingVibration",
    "EstimationProblem",
    "FrozenFlows",
    "FullStatePlant",
    "LoopHardware",
    "ModalTurbulence",
    "PositionLoop",
    "SinusoidalVibration",
    "Spectrum",
    "StepResponse",
    "SumSpectrum",
    "TabulatedSpectrum",
    "TipTiltPlant",
    "Truth",
    "Vibration",
    "ar1_turbulence",
    "ar2_turbulence",
    "illuminated_subapertures",
    "le_roux_pole",
    "modal_turbulence",
    "nm_per_mas",
    "noll_orders",
    "pyramid_modal_noise_nm",
    "pyramid_tilt_noise_nm",
    "retuned_plant",
    "spread_plant",
    "tip_tilt_plant",
]
