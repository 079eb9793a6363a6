"""Controllers for other programs: C source, MATLAB files, SPECULA's transfer-function files."""

from lbt_synth.export.c_source import export_c
from lbt_synth.export.cost import FrameCost, frame_cost
from lbt_synth.export.iir import export_iir
from lbt_synth.export.matlab import export_mat
from lbt_synth.export.result import Exported

__all__ = ["Exported", "FrameCost", "export_c", "export_iir", "export_mat", "frame_cost"]
