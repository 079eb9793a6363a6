"""Gain files: FITS (loaded as it is by SPECULA's state-space filter), NPZ and JSON."""

from lbt_synth.gainfile.store import (
    SCHEMA_VERSION,
    load_gain,
    load_with_digest,
    require_gain_name,
    save_gain,
)

__all__ = ["SCHEMA_VERSION", "load_gain", "load_with_digest", "require_gain_name", "save_gain"]
