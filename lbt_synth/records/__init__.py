"""What an observatory recorded: files of any origin, their health, the pseudo-open loop."""

from lbt_synth.records.build import loop_record, require_length
from lbt_synth.records.health import HEADINGS, Finding, RecordHealth
from lbt_synth.records.load import KINDS, load_record
from lbt_synth.records.of_telemetry import record_of
from lbt_synth.records.priors import (
    LinePrior,
    lines_of_accelerometer,
    load_accelerations,
    load_lines,
)
from lbt_synth.records.record import LoopRecord
from lbt_synth.records.spectrum import SpectrumRecord
from lbt_synth.records.units import UNITS

__all__ = [
    "HEADINGS",
    "KINDS",
    "UNITS",
    "Finding",
    "LinePrior",
    "LoopRecord",
    "RecordHealth",
    "SpectrumRecord",
    "lines_of_accelerometer",
    "load_accelerations",
    "load_lines",
    "load_record",
    "loop_record",
    "record_of",
    "require_length",
]
