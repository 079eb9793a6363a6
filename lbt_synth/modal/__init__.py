"""Control of hundreds of modes: reconstructor, controllers of all modes, their loop."""

from lbt_synth.modal.filters import ModalFilters, modal_filters
from lbt_synth.modal.loop import ModalLoop, ModalRun, modal_loop
from lbt_synth.modal.mixed import MixedController
from lbt_synth.modal.reconstructor import Reconstructor, project_out, reconstructor

__all__ = [
    "MixedController",
    "ModalFilters",
    "ModalLoop",
    "ModalRun",
    "Reconstructor",
    "modal_filters",
    "modal_loop",
    "project_out",
    "reconstructor",
]
