"""Control of hundreds of modes: reconstructor, controllers of all modes, their loop."""

from lbt_synth.modal.filters import ModalFilters, modal_filters
from lbt_synth.modal.gains import ModalGains, modal_gains
from lbt_synth.modal.loop import ModalLoop, ModalRun, modal_loop
from lbt_synth.modal.mixed import MixedController
from lbt_synth.modal.observed import modal_gains_from_telemetry
from lbt_synth.modal.reconstructor import Reconstructor, project_out, reconstructor

__all__ = [
    "MixedController",
    "ModalFilters",
    "ModalGains",
    "ModalLoop",
    "ModalRun",
    "Reconstructor",
    "modal_filters",
    "modal_gains",
    "modal_gains_from_telemetry",
    "modal_loop",
    "project_out",
    "reconstructor",
]
