"""Conic programmes (the only importer of cvxpy)."""

from lbt_synth.lmi.hinf import hinf_lmi, least_gamma_lmi
from lbt_synth.lmi.kalman import kalman_sdp
from lbt_synth.lmi.mixed import InnovationProgramme
from lbt_synth.lmi.polytopic import SegmentFilter, segment_filter
from lbt_synth.lmi.shaping import ShapingSolution, least, least_relaxation
from lbt_synth.lmi.solver import LmiSolution

__all__ = [
    "InnovationProgramme",
    "LmiSolution",
    "SegmentFilter",
    "ShapingSolution",
    "hinf_lmi",
    "kalman_sdp",
    "least",
    "least_gamma_lmi",
    "least_relaxation",
    "segment_filter",
]
