"""Telemetry of a loop: a record, its files, and those of the AOT standard."""

from lbt_synth.telemetry.aot import losses
from lbt_synth.telemetry.layout import LAYERS
from lbt_synth.telemetry.of_simulation import telemetry_of
from lbt_synth.telemetry.record import CONVENTION, Telemetry
from lbt_synth.telemetry.store import (
    FORMATS,
    load_telemetry,
    require_telemetry_name,
    save_telemetry,
)

__all__ = [
    "CONVENTION",
    "FORMATS",
    "LAYERS",
    "Telemetry",
    "load_telemetry",
    "losses",
    "require_telemetry_name",
    "save_telemetry",
    "telemetry_of",
]
