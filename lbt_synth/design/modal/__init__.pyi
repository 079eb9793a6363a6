from .gains import modal_gains as modal_gains
from .gains import modal_gains_from_telemetry as modal_gains_from_telemetry
from .mixed_controller import MixedController as MixedController
from .stack import ModalFilters as ModalFilters
from .stack import modal_filters as modal_filters
