"""Control of hundreds of modes: reconstructor, mixed controller."""

from lbt_synth.modal.mixed import MixedController
from lbt_synth.modal.reconstructor import Reconstructor, project_out, reconstructor

__all__ = [
    "MixedController",
    "Reconstructor",
    "project_out",
    "reconstructor",
]
