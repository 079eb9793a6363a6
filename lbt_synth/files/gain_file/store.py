"""Save and load designs; what is loaded has been checked."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.design import Design, EstimatorDesign
from lbt_synth.errors import GainFileError, OutputError, SchemaVersionError
from lbt_synth.files.gain_file import formats
from lbt_synth.files.gain_file.contents import Meta, pack_design, unpack_design
from lbt_synth.storage.array_file import digest as _digest
from lbt_synth.storage.array_file import reason
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.validation import frozen

SCHEMA = "lbt_synth gain file"
SCHEMA_VERSION = 1
_FORMATS = {
    ".fits": (formats.write_fits, formats.read_fits),
    ".npz": (formats.write_npz, formats.read_npz),
    ".json": (formats.write_json, formats.read_json),
}


def require_gain_name(path: str | os.PathLike[str]) -> Path:
    """Refuse a file name that is not that of a gain file."""
    target = Path(path)
    if target.suffix.lower() not in _FORMATS:
        raise OutputError(
            f"a gain file must end in {', '.join(_FORMATS)}; got {target.name!r}.", path=target
        )
    return target


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
    write, _ = _FORMATS[target.suffix.lower()]
    arrays, meta = pack_design(design)
    meta = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **meta}
    meta["digest"] = _digest(arrays, meta)
    content = write(arrays, json.dumps(meta, allow_nan=False), _header(design, meta))
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
        The design, with the certificate that it was saved with; compute it anew
        with ``design.recertified()``.

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
    source = Path(path)
    if source.suffix.lower() not in _FORMATS:
        raise GainFileError(
            f"a gain file must end in {', '.join(_FORMATS)}; got {source.name!r}.", path=source
        )
    _, read = _FORMATS[source.suffix.lower()]
    try:
        content = source.read_bytes()
    except OSError as error:
        raise GainFileError(f"cannot read {source}: {error.strerror}.", path=source) from error
    except ValueError as error:
        raise GainFileError(f"cannot read {str(source)!r}: {error}.", path=source) from error
    try:
        arrays, text = read(content)
        meta = json.loads(text)
        digest = _digest(arrays, meta) if isinstance(meta, dict) else ""
    except Exception as error:  # foreign bytes: three decoders raise whatever they like
        raise GainFileError(
            f"{source} is no gain file, or it is damaged: {reason(error)}. "
            "Write it again with lbt-synth design.",
            path=source,
        ) from error
    _check_schema(meta, source)
    if meta.get("digest") != digest:
        raise GainFileError(
            f"{source} is damaged: its content does not match its digest. "
            "Write it again with lbt-synth design.",
            path=source,
        )
    for name, array in arrays.items():
        if not np.all(np.isfinite(array)):
            raise GainFileError(
                f"{source} is damaged: {name} holds values that are not finite.", path=source
            )
    try:
        design = unpack_design({name: frozen(array) for name, array in arrays.items()}, meta)
    except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError) as error:
        raise GainFileError(
            f"{source} is inconsistent: {reason(error)}. Write it again with lbt-synth design.",
            path=source,
        ) from error
    return design, digest


def _check_schema(meta: Any, source: Path) -> None:
    if not isinstance(meta, dict) or meta.get("schema") != SCHEMA:
        raise GainFileError(f"{source} is not a gain file of lbt_synth.", path=source)
    version = meta.get("schema_version")
    if version != SCHEMA_VERSION:
        raise SchemaVersionError(
            f"{source} has layout version {version!r}; this lbt_synth reads {SCHEMA_VERSION}. "
            "Read it with the version that wrote it.",
            path=source,
        )


def _header(design: Design, meta: Meta) -> dict[str, tuple[Any, str]]:
    """Cards for people who look at the FITS header; META is what is read back."""
    cards: dict[str, tuple[Any, str]] = {
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
    return cards
