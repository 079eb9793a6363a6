"""Designs: Kalman, H-infinity and integrator, each certified before it is returned."""

from lbt_synth.design.central import central
from lbt_synth.design.hinf import hinf
from lbt_synth.design.integrator import (
    integrator,
    integrator_gain_limit,
    model_integrator,
    optimal_integrator,
)
from lbt_synth.design.kalman import kalman
from lbt_synth.design.lqg import lqg
from lbt_synth.design.lqg_result import LqgDesign
from lbt_synth.design.mixed import mixed
from lbt_synth.design.polytopic import PolytopicDesign, polytopic
from lbt_synth.design.result import (
    Design,
    EstimatorDesign,
    FilterDesign,
    IntegratorDesign,
    SolverReport,
)
from lbt_synth.design.robust import robust
from lbt_synth.design.shape import shape
from lbt_synth.design.shaped import ShapedDesign

__all__ = [
    "Design",
    "EstimatorDesign",
    "FilterDesign",
    "IntegratorDesign",
    "LqgDesign",
    "PolytopicDesign",
    "ShapedDesign",
    "SolverReport",
    "central",
    "hinf",
    "integrator",
    "integrator_gain_limit",
    "kalman",
    "lqg",
    "mixed",
    "model_integrator",
    "optimal_integrator",
    "polytopic",
    "robust",
    "shape",
]
