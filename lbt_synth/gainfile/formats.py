"""The three file formats: arrays and one text of metadata, to bytes and back.

Each ``read_*`` raises ``ValueError``, ``KeyError`` or ``OSError`` on bytes that
are not its format; the caller turns that into a GainFileError.
"""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from lbt_synth.fitsfile import fits_bytes
from lbt_synth.validation import FloatArray

FITS_LAYOUT_VERSION = 1  # of SPECULA's state-space filter file
_TEXT = "META"


def write_fits(arrays: Mapping[str, FloatArray], text: str, header: Mapping[str, Any]) -> bytes:
    """Write HDUs A, B, C, D first, as SPECULA's SsrFilterData wants them, then the others."""
    cards = {
        "VERSION": (FITS_LAYOUT_VERSION, "layout of the HDUs A, B, C, D"),
        "NFILTER": (arrays["B"].shape[1], "inputs of the controller"),
        "NSTATES": (arrays["A"].shape[0], "states of the controller"),
        **header,
    }
    everything: dict[str, Any] = {**arrays, _TEXT: np.frombuffer(text.encode(), dtype=np.uint8)}
    return fits_bytes(cards, everything)


def read_fits(content: bytes) -> tuple[dict[str, FloatArray], str]:
    """Read the arrays and the text of :func:`write_fits`."""
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)
        try:
            with fits.open(
                io.BytesIO(content), memmap=False, lazy_load_hdus=False, checksum=True
            ) as units:
                data = {unit.name: np.array(unit.data) for unit in units[1:]}
        except Exception as error:  # astropy has no common class for what damage makes it raise
            raise ValueError("its FITS structure or a checksum is broken") from error
    text = data.pop(_TEXT).astype(np.uint8).tobytes().decode()
    return {name: array.astype(np.float64) for name, array in data.items()}, text


def write_npz(arrays: Mapping[str, FloatArray], text: str, header: Mapping[str, Any]) -> bytes:
    """Write a NumPy archive; the text is an array of bytes, so nothing is pickled."""
    del header
    buffer = io.BytesIO()
    everything: dict[str, Any] = {**arrays, _TEXT: np.frombuffer(text.encode(), dtype=np.uint8)}
    np.savez(buffer, **everything)
    return buffer.getvalue()


def read_npz(content: bytes) -> tuple[dict[str, FloatArray], str]:
    """Read the arrays and the text of :func:`write_npz`."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            data = {name: np.array(archive[name]) for name in archive.files}
    except Exception as error:  # zip, zlib and NumPy each raise their own
        raise ValueError("it is not a NumPy archive") from error
    text = data.pop(_TEXT).astype(np.uint8).tobytes().decode()
    return {name: array.astype(np.float64) for name, array in data.items()}, text


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
