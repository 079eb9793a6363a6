"""Saves telemetry to files, in the package's own layout or another, and loads and checks it."""

from __future__ import annotations

import os
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import lbt_synth
from lbt_synth.errors import OutputError, ProblemError, TelemetryError
from lbt_synth.files.file_checks import READERS, FileKind
from lbt_synth.files.telemetry import aot
from lbt_synth.files.telemetry.telemetry import FACTS, LAYERS, REQUIRED, Telemetry
from lbt_synth.linear import Controller
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import Cards
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import FloatArray, choice

PRECISIONS = ("float64", "float32")
Meta = dict[str, Any]
_LARGEST_CARD = 2**63 - 1
FORMATS = ("fits", "npz", "aot")
_ENDINGS = ".fits, .npz or .aot.fits"
_KINDS = {".aot.fits": "aot", ".fits": "fits", ".npz": "npz"}  # the longer ending first
_KIND = FileKind(
    name="telemetry file",
    schema="lbt_synth telemetry",
    version=1,
    error=TelemetryError,
    version_error=TelemetryError,
    again="Try another copy, or write it again with lbt.files.save_telemetry.",
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
    cards = partial(primary_cards, telemetry)
    return _KIND.write(target, arrays, meta, cards, layer_cards(telemetry))


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
    if source.suffix.lower() not in READERS:
        raise TelemetryError(f"telemetry must end in {_ENDINGS}; got {source.name!r}.", path=source)
    content, is_fits = read_bytes(source, TelemetryError), source.suffix.lower() == ".fits"
    with _KIND.rebuilding(source):
        if is_fits and aot.is_aot(content):
            return aot.from_bytes(content, source)
        return unpack(*_KIND.decode(content, source))


def pack(telemetry: Telemetry, precision: str) -> tuple[dict[str, npt.NDArray[Any]], Meta]:
    """Return the arrays and the metadata; ``precision`` is that of the series."""
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, layer in LAYERS.items():
        if (value := getattr(telemetry, layer.field)) is None:
            continue
        arrays[name] = value
        if precision == "float32" and layer.is_series and layer.field != "times_s":
            with np.errstate(over="ignore"):
                arrays[name] = value.astype(np.float32)
            if not np.all(np.isfinite(arrays[name])):
                raise ProblemError(
                    f"{layer.field} has values beyond the range of float32; write float64."
                )
    meta: Meta = {
        "schema": _KIND.schema,
        "schema_version": _KIND.version,
        "library_version": lbt_synth.__version__,
        "convention": telemetry.convention,
        **{name: getattr(telemetry, name) for name in FACTS},
        "metadata": dict(telemetry.metadata),
    }
    if (k := telemetry.controller) is not None:
        arrays |= {f"CTRL_{name}": getattr(k, name) for name in "ABCD"}
        meta["controller_dt_s"] = k.dt_s
    if telemetry.mirror is not None:
        meta["mirror"] = asdict(telemetry.mirror)
    return arrays, meta


def unpack(arrays: dict[str, FloatArray], meta: Meta) -> Telemetry:
    """Rebuild telemetry; missing keys raise KeyError, what does not fit a ProblemError."""
    left = dict(arrays)
    fields: dict[str, Any] = {
        layer.field: left.pop(name)
        for name, layer in LAYERS.items()
        if name in left or layer.field in REQUIRED
    }
    if "controller_dt_s" in meta:
        fields["controller"] = Controller(
            **{name: left.pop(f"CTRL_{name}") for name in "ABCD"}, dt_s=meta["controller_dt_s"]
        )
    if left:
        raise ValueError(f"it has arrays that no telemetry has: {', '.join(sorted(left))}")
    fields.pop("mirror_taps", None)  # they follow from the mirror
    if "mirror" in meta:  # a mirror that settles at once is not in the file
        fields["mirror"] = PositionLoop(**meta["mirror"])
    fields |= {name: meta[name] for name in FACTS}
    return Telemetry(**fields, metadata=dict(meta["metadata"]))


def primary_cards(telemetry: Telemetry, meta: Meta) -> dict[str, tuple[Any, str]]:
    """Cards for people who look at the header; META is what is read back."""
    cards: dict[str, tuple[Any, str]] = {
        "CREATOR": (f"lbt_synth {meta['library_version']}", "writer of this file"),
        "LBTTELEM": (_KIND.version, "version of the lbt_synth telemetry layout"),
    }
    for name, (card, comment) in FACTS.items():
        value = getattr(telemetry, name)
        too_large = isinstance(value, int) and value > _LARGEST_CARD
        if card and value is not None and not too_large:
            cards[card] = (value, comment)
    cards["TIMING"] = (telemetry.convention, "")
    cards["SHA256"] = (meta["digest"], "")
    return cards


def layer_cards(telemetry: Telemetry) -> dict[str, Cards]:
    """Cards of each array: unit, meaning, axes."""
    out: dict[str, Cards] = {}
    for name, layer in LAYERS.items():
        cards: dict[str, tuple[Any, str]] = {}
        if unit := layer.unit_in(telemetry):
            cards["BUNIT"] = (unit, "rms of wavefront" if unit == "nm" else "")
        cards["CONTENT"] = (layer.meaning, "")
        for number, axis in enumerate(reversed(layer.axes.split(", ")), start=1):
            cards[f"CTYPE{number}"] = (axis.upper(), "")  # FITS counts axes from the fastest
        out[name] = cards
    return out
