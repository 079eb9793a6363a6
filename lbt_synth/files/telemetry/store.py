"""Saves telemetry to files, and loads and checks it."""

from __future__ import annotations

import json
import os
from pathlib import Path

from lbt_synth.errors import OutputError, TelemetryError
from lbt_synth.files.file_checks import FileKind
from lbt_synth.files.telemetry import aot
from lbt_synth.files.telemetry.native_layout import (
    PRECISIONS,
    SCHEMA,
    SCHEMA_VERSION,
    layer_cards,
    pack,
    primary_cards,
    unpack,
)
from lbt_synth.files.telemetry.telemetry import Telemetry
from lbt_synth.storage.array_file import digest, fits_bytes, npz_bytes, read_fits, read_npz
from lbt_synth.storage.atomic_files import read_bytes, write_atomically
from lbt_synth.validation import choice

FORMATS = ("fits", "npz", "aot")
_ENDINGS = ".fits, .npz or .aot.fits"
_KINDS = {".aot.fits": "aot", ".fits": "fits", ".npz": "npz"}  # the longer ending first
_KIND = FileKind(
    name="telemetry file",
    schema=SCHEMA,
    version=SCHEMA_VERSION,
    error=TelemetryError,
    version_error=TelemetryError,
)


def require_telemetry_name(path: str | os.PathLike[str], format: str | None = None) -> str:  # noqa: A002
    """Return the format of a file that is to be written."""
    target = Path(path)
    by_name = next((_KINDS[end] for end in _KINDS if target.name.lower().endswith(end)), None)
    if by_name is None:
        raise OutputError(f"telemetry must end in {_ENDINGS}; got {target.name!r}.", path=target)
    kind = by_name if format is None else format
    if kind not in FORMATS:
        raise OutputError(
            f"the format of telemetry must be one of {', '.join(FORMATS)}; got {format!r}.",
            path=target,
        )
    if kind != by_name and (by_name, kind) != ("fits", "aot"):
        raise OutputError(
            f"the name {target.name!r} does not fit the format {format!r}: fits ends in .fits, "
            "npz in .npz, aot in .aot.fits or .fits.",
            path=target,
        )
    if kind == "aot":
        aot.require_aotpy(target)
    return kind


def save_telemetry(
    path: str | os.PathLike[str],
    telemetry: Telemetry,
    *,
    format: str | None = None,  # noqa: A002 - the word of the command line
    precision: str = "float64",
) -> Path:
    """Write telemetry to a file, whole or not at all.

    Parameters
    ----------
    path : path-like
        File to write; the ending chooses the format: ``.fits`` or ``.npz`` in the layout of
        this package, ``.aot.fits`` in that of the Adaptive Optics Telemetry standard (which
        needs the extra ``aot`` and does not hold everything).
    telemetry : Telemetry
        The telemetry.
    format : {"fits", "npz", "aot"}, optional
        The format, where the ending does not give it.
    precision : {"float64", "float32"}, optional
        Of the series; matrices, images and times are float64.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OutputError
        If the name is none of these, the file cannot be written, or the extra is missing.
    ProblemError
        If a value does not fit into the precision.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> seen = lbt.files.Telemetry(
    ...     frame_rate_hz=800, commands=[[0.0], [1.5]], measurements=[[3.0], [2.0]]
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = lbt.files.save_telemetry(pathlib.Path(folder) / "night.fits", seen)
    ...     lbt.files.load_telemetry(file).commands.ravel().tolist()
    [0.0, 1.5]
    """
    target = Path(path)
    kind = require_telemetry_name(target, format)
    if not isinstance(telemetry, Telemetry):
        raise OutputError(
            f"a telemetry file holds a Telemetry; got {type(telemetry).__name__}.", path=target
        )
    choice(precision, "precision", PRECISIONS)
    arrays, meta = pack(telemetry, precision)
    if kind == "aot":
        return write_atomically(target, aot.to_bytes(telemetry, precision, target))
    meta["digest"] = digest(arrays, meta)
    text = json.dumps(meta, allow_nan=False)
    if kind == "npz":
        return write_atomically(target, npz_bytes(arrays, text))
    cards, headers = primary_cards(telemetry, meta), layer_cards(telemetry)
    return write_atomically(target, fits_bytes(cards, arrays, text, headers=headers))


def load_telemetry(path: str | os.PathLike[str]) -> Telemetry:
    """Read a telemetry file and check it: schema, digest, shapes, finiteness.

    Parameters
    ----------
    path : path-like
        File in the layout of this package (``.fits``, ``.npz``) or of the Adaptive Optics
        Telemetry standard (``.fits``); the header of a FITS file says which of the two it is.

    Returns
    -------
    Telemetry
        The telemetry.

    Raises
    ------
    TelemetryError
        If the file is missing, damaged, foreign, of a later layout, or the extra ``aot`` is
        needed and missing.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.files.load_telemetry("nowhere.fits")
    Traceback (most recent call last):
        ...
    lbt_synth.errors.TelemetryError: cannot read nowhere.fits: No such file or directory.
    """
    source = Path(path)
    if source.suffix.lower() not in (".fits", ".npz"):
        raise TelemetryError(f"telemetry must end in {_ENDINGS}; got {source.name!r}.", path=source)
    content, is_fits = read_bytes(source, TelemetryError), source.suffix.lower() == ".fits"
    with _KIND.rebuilding(source):
        if is_fits and aot.is_aot(content):
            return aot.from_bytes(content, source)
        return unpack(*_KIND.decode(content, read_fits if is_fits else read_npz, source))
