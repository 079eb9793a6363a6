"""The whole adaptive-optics system, on optics simulated by SPECULA (an optional extra)."""

from lbt_synth.endtoend.calibration import Calibration, cache_directory, calibrate
from lbt_synth.endtoend.result import EndToEndRun
from lbt_synth.endtoend.run import run_end_to_end
from lbt_synth.endtoend.setup import EndToEndSetup
from lbt_synth.endtoend.system import EndToEndSystem

__all__ = [
    "Calibration",
    "EndToEndRun",
    "EndToEndSetup",
    "EndToEndSystem",
    "cache_directory",
    "calibrate",
    "run_end_to_end",
]
