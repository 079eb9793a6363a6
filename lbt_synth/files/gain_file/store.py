"""Saves designs to gain files, and loads and checks them."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from lbt_synth.design import Design
from lbt_synth.design.record import DesignRecord
from lbt_synth.errors import GainFileError, OutputError, SchemaVersionError
from lbt_synth.files.file_checks import FileKind
from lbt_synth.files.gain_file.contents import SCHEMA, SCHEMA_VERSION, pack_design, unpack_design
from lbt_synth.files.gain_file.fits_layout import write_fits
from lbt_synth.files.gain_file.json_format import read_json, write_json
from lbt_synth.storage.array_file import digest, npz_bytes, read_fits, read_npz
from lbt_synth.storage.atomic_files import read_bytes, require_ending, write_atomically
from lbt_synth.validation import frozen_copy

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
    record = pack_design(design)
    arrays = record.arrays
    meta = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **record.meta}
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
        return unpack_design(record), str(meta["digest"])
