"""What a gain file holds: a design as named arrays and plain metadata, and back."""

from __future__ import annotations

import lbt_synth
from lbt_synth.design import Design
from lbt_synth.design.record import DesignRecord, record_common
from lbt_synth.methods.registry import method_of_design

SCHEMA = "lbt_synth gain file"
SCHEMA_VERSION = 1
CONVENTION = (
    "x(k+1) = A x(k) + B y(k), u(k) = C x(k+1) + D y(k): the output is read from the new state. "
    "y(k) = SENSOR phi_res(k-1) + noise; phi_cor(k) = INFLUENCE u(k-delay_frames+1), or the "
    "mirror's exposure-averaged answer to these commands where META holds a mirror. "
    "GAIN_PREDICTOR: x(k+1|k) = A x(k|k-1) + G (y - C x(k|k-1)); "
    "GAIN_FILTER: x(k|k) = x(k|k-1) + G (y - C x(k|k-1)); A, B, C, D, L of the plant in PLANT_*."
)


def pack_design(design: Design) -> DesignRecord:
    """Record a design whole: what all designs have, and what its method adds."""
    said = DesignRecord(meta={"library_version": lbt_synth.__version__, "convention": CONVENTION})
    return said | record_common(design) | method_of_design(design.method).pack(design)


def unpack_design(record: DesignRecord) -> Design:
    """Rebuild a design; missing keys raise KeyError, wrong sizes a ProblemError."""
    return method_of_design(record.meta["method"]).unpack(record)
