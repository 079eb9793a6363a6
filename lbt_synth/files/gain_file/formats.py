"""The three file formats: arrays and one text of metadata, to bytes and back.

Each ``read_*`` raises ``ValueError``, ``KeyError`` or ``OSError`` on bytes that
are not its format; the caller turns that into a GainFileError.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from lbt_synth.storage.array_file import fits_bytes, npz_bytes, read_fits, read_npz
from lbt_synth.validation import FloatArray

__all__ = ["read_fits", "read_json", "read_npz", "write_fits", "write_json", "write_npz"]

FITS_LAYOUT_VERSION = 1  # of SPECULA's state-space filter file


def write_fits(arrays: Mapping[str, FloatArray], text: str, header: Mapping[str, Any]) -> bytes:
    """Write HDUs A, B, C, D first, as SPECULA's SsrFilterData wants them, then the others."""
    cards = {
        "VERSION": (FITS_LAYOUT_VERSION, "layout of the HDUs A, B, C, D"),
        "NFILTER": (arrays["B"].shape[1], "inputs of the controller"),
        "NSTATES": (arrays["A"].shape[0], "states of the controller"),
        **header,
    }
    return fits_bytes(arrays, text, cards)


def write_npz(arrays: Mapping[str, FloatArray], text: str, header: Mapping[str, Any]) -> bytes:
    """Write a NumPy archive, without the header."""
    del header
    return npz_bytes(arrays, text)


def write_json(arrays: Mapping[str, FloatArray], text: str, header: Mapping[str, Any]) -> bytes:
    """Write one JSON object; numbers keep all their digits."""
    del header
    document = {"meta": json.loads(text), "arrays": {k: v.tolist() for k, v in arrays.items()}}
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def read_json(content: bytes) -> tuple[dict[str, FloatArray], str]:
    """Read the arrays and the text of :func:`write_json`."""
    document = json.loads(content.decode())
    if not isinstance(document, dict):
        raise ValueError("the JSON is not an object")  # noqa: TRY004 - one kind of refusal
    arrays = {k: np.array(v, dtype=np.float64) for k, v in document["arrays"].items()}
    return arrays, json.dumps(document["meta"])
