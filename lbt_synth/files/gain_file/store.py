"""Gain files: a design as named arrays and metadata, saved as FITS, NPZ or JSON, and loaded."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import lbt_synth
from lbt_synth.design import Design, EstimatorDesign
from lbt_synth.design.record import DesignRecord, Meta, record_common
from lbt_synth.errors import GainFileError, OutputError, SchemaVersionError
from lbt_synth.files.file_checks import FileKind
from lbt_synth.methods.registry import method_of_design
from lbt_synth.storage.array_file import digest, fits_bytes, npz_bytes, read_fits, read_npz
from lbt_synth.storage.atomic_files import require_ending, write_atomically
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import FloatArray, frozen_copy

SCHEMA = "lbt_synth gain file"
SCHEMA_VERSION = 1
CONVENTION = (
    "x(k+1) = A x(k) + B y(k), u(k) = C x(k+1) + D y(k): the output is read from the new state. "
    "y(k) = SENSOR phi_res(k-1) + noise; phi_cor(k) = INFLUENCE u(k-delay_frames+1), or the "
    "mirror's exposure-averaged answer to these commands where META holds a mirror. "
    "GAIN_PREDICTOR: x(k+1|k) = A x(k|k-1) + G (y - C x(k|k-1)); "
    "GAIN_FILTER: x(k|k) = x(k|k-1) + G (y - C x(k|k-1)); A, B, C, D, L of the plant in PLANT_*."
)
FITS_LAYOUT_VERSION = 1  # of SPECULA's state-space filter file


def write_fits(arrays: Mapping[str, FloatArray], text: str, design: Design, meta: Meta) -> bytes:
    """Write the arrays and the metadata's text under a header for people.

    The HDUs A, B, C, D come first, as SPECULA's ``SsrFilterData`` loads them; the other arrays
    follow, and META, the text that :func:`load_gain` reads back.
    """
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


def write_json(arrays: Mapping[str, FloatArray], text: str) -> bytes:
    """Write one JSON object; numbers keep all their digits."""
    document = {"meta": json.loads(text), "arrays": {k: v.tolist() for k, v in arrays.items()}}
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def read_json(content: bytes) -> tuple[dict[str, FloatArray], str]:
    """Read the arrays and the text of :func:`write_json`; other bytes raise some exception."""
    document = json.loads(content.decode())
    if not isinstance(document, dict):
        raise ValueError("the JSON is not an object")  # noqa: TRY004 - one kind of refusal
    arrays = {k: np.array(v, dtype=np.float64) for k, v in document["arrays"].items()}
    return arrays, json.dumps(document["meta"])


_READERS = {".fits": read_fits, ".npz": read_npz, ".json": read_json}
_KIND = FileKind(
    name="gain file",
    schema=SCHEMA,
    version=SCHEMA_VERSION,
    error=GainFileError,
    version_error=SchemaVersionError,
    advice=" Write it again with lbt-synth design.",
)


def require_gain_name(path: str | os.PathLike[str]) -> Path:
    """Refuse a file name that is not that of a gain file."""
    return require_ending(path, "a gain file", _READERS)


def save_gain(path: str | os.PathLike[str], design: Design) -> Path:
    """Write a design to a gain file, whole or not at all.

    A FITS file has the controller in its HDUs A, B, C, D, in the new-state
    convention; SPECULA's state-space filter loads it as it is.

    Parameters
    ----------
    path : path-like
        File to write; the ending chooses the format: ``.fits``, ``.npz`` or ``.json``.
    design : Design
        The design.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OutputError
        If the ending is none of these, or the file cannot be written.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = lbt.save_gain(pathlib.Path(folder) / "slow.fits", design)
    ...     lbt.load_gain(file).method
    'integrator'
    """
    target = require_gain_name(path)
    if not isinstance(design, Design):
        raise OutputError(f"a gain file holds a Design; got {type(design).__name__}.", path=target)
    header = DesignRecord(
        meta={
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "library_version": lbt_synth.__version__,
            "convention": CONVENTION,
        }
    )
    record = header | record_common(design) | method_of_design(design.method).pack(design)
    arrays, meta = record.arrays, record.meta
    meta["digest"] = digest(arrays, meta)
    text, ending = json.dumps(meta, allow_nan=False), target.suffix.lower()
    if ending == ".fits":
        content = write_fits(arrays, text, design, meta)
    else:
        content = npz_bytes(arrays, text) if ending == ".npz" else write_json(arrays, text)
    return write_atomically(target, content)


def load_gain(path: str | os.PathLike[str]) -> Design:
    """Read a gain file and check it: schema, digest, shapes, finiteness.

    Parameters
    ----------
    path : path-like
        File written by :func:`save_gain`.

    Returns
    -------
    Design
        The design, with the certificate that it was saved with; ``design.recertify()`` computes
        it again.

    Raises
    ------
    GainFileError
        If the file is missing, damaged or no gain file.
    SchemaVersionError
        If its layout is of another version.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.load_gain("nowhere.fits")
    Traceback (most recent call last):
        ...
    lbt_synth.errors.GainFileError: cannot read nowhere.fits: No such file or directory.
    """
    return load_with_digest(path)[0]


def load_with_digest(path: str | os.PathLike[str]) -> tuple[Design, str]:
    """Read a gain file as :func:`load_gain` does, and return its digest beside the design."""
    source = require_ending(path, "a gain file", _READERS, GainFileError)
    content = read_bytes(source, GainFileError)
    arrays, meta = _KIND.decode(content, _READERS[source.suffix.lower()], source)
    for name, array in arrays.items():
        if not np.all(np.isfinite(array)):
            raise GainFileError(
                f"{source} is damaged: {name} holds values that are not finite.", path=source
            )
    record = DesignRecord({name: frozen_copy(array) for name, array in arrays.items()}, meta)
    with _KIND.rebuilding(source):
        return method_of_design(meta["method"]).unpack(record), str(meta["digest"])
