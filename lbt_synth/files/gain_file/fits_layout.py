"""The FITS layout of a gain file: its HDUs, their order and the cards of its header.

The HDUs A, B, C, D come first, as SPECULA's ``SsrFilterData`` loads them; the other arrays
follow, and META, the text that :func:`~lbt_synth.load_gain` reads back.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lbt_synth.design import Design, EstimatorDesign
from lbt_synth.design.record import Meta
from lbt_synth.files.gain_file.contents import SCHEMA_VERSION
from lbt_synth.storage.array_file import fits_bytes
from lbt_synth.validation import FloatArray

FITS_LAYOUT_VERSION = 1  # of SPECULA's state-space filter file


def write_fits(arrays: Mapping[str, FloatArray], text: str, design: Design, meta: Meta) -> bytes:
    """Write the arrays and the metadata's text under a header for people."""
    cards: dict[str, tuple[Any, str]] = {
        "VERSION": (FITS_LAYOUT_VERSION, "layout of the HDUs A, B, C, D"),
        "NFILTER": (arrays["B"].shape[1], "inputs of the controller"),
        "NSTATES": (arrays["A"].shape[0], "states of the controller"),
        "CREATOR": (f"lbt_synth {meta['library_version']}", "writer of this file"),
        "LBTSCHEM": (SCHEMA_VERSION, "version of the lbt_synth layout"),
        "METHOD": (design.method, "synthesis"),
        "NEWSTATE": (True, "u(k) = C x(k+1) + D y(k)"),
    }
    if design.hardware is not None:
        cards["RATE_HZ"] = (design.hardware.frame_rate_hz, "[Hz] frame rate")
        cards["DELAY"] = (design.hardware.delay_frames, "[frames] total delay")
    if isinstance(design, EstimatorDesign):
        cards["RMS"] = (design.rms, "estimation error, standard deviation")
        cards["GAMMA"] = (design.gamma, "estimation error, H-infinity norm")
    cards["SHA256"] = (meta["digest"], "")
    return fits_bytes(cards, arrays, text)
