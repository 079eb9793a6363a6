"""Gain files: a design as named arrays and metadata, saved as FITS or NPZ, and loaded."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import lbt_synth
from lbt_synth.design import Design
from lbt_synth.design.record import (
    DesignRecord,
    Meta,
    certificate_record,
    rebuild_design,
    record_design,
)
from lbt_synth.errors import CertificateError, GainFileError, OutputError, SchemaVersionError
from lbt_synth.files.file_checks import READERS, FileKind
from lbt_synth.methods.registry import method_named
from lbt_synth.storage.array_file import read_cards
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import agree, frozen_copy, number, real_array, require_instance, text

SCHEMA = "lbt_synth gain file"
SCHEMA_VERSION = 5
CONVENTION = (
    "x(k+1) = A x(k) + B y(k), u(k) = C x(k+1) + D y(k): the output is read from the new state. "
    "y(k) = SENSOR phi_res(k-1) + noise; phi_cor(k) = INFLUENCE u(k-delay_frames+1), or the "
    "mirror's exposure-averaged answer to these commands where META holds a mirror. "
    "GAIN_PREDICTOR: x(k+1|k) = A x(k|k-1) + G (y - C x(k|k-1)); A, B, C, D, L of the plant in "
    "PLANT_*."
)
FITS_LAYOUT_VERSION = 1  # of SPECULA's state-space filter file
_ARRAY_TOLERANCE = 1e-9  # relative, of an entry; and a thousandth of that, of the largest
_NUMBER_TOLERANCE = 1e-6  # relative


def write_cards(design: Design, meta: Meta) -> dict[str, tuple[Any, str]]:
    """Return the header of a FITS file, for people and programs that read nothing else."""
    cards: dict[str, tuple[Any, str]] = {
        "VERSION": (FITS_LAYOUT_VERSION, "layout of the HDUs A, B, C, D"),
        "NFILTER": (design.controller.B.shape[-1], "inputs of the controller"),
        "NSTATES": (design.controller.n_states, "states of the controller"),
        "CREATOR": (f"lbt_synth {meta['library_version']}", "writer of this file"),
        "LBTSCHEM": (SCHEMA_VERSION, "version of the lbt_synth layout"),
        "METHOD": (design.method, "synthesis"),
        "NEWSTATE": (True, "u(k) = C x(k+1) + D y(k)"),
    }
    if design.hardware is not None:
        cards["RATE_HZ"] = (design.hardware.frame_rate_hz, "[Hz] frame rate")
        cards["DELAY"] = (design.hardware.delay_frames, "[frames] total delay")
    if design.diameter_m is not None:
        cards["DIAMETER"] = (design.diameter_m, "[m] telescope diameter")
    if design.shown_unit is not None:
        cards["SHOWUNIT"] = (design.shown_unit, "in which people see the wavefront")
    cards |= {
        claim.name.upper(): (design.claims[claim.name], claim.heading)
        for claim in design.CLAIMS
        if claim.name in ("rms", "gamma") and claim.name in design.claims
    }
    cards["SHA256"] = (meta["digest"], "")
    return cards


_KIND = FileKind(
    name="gain file",
    schema=SCHEMA,
    version=SCHEMA_VERSION,
    error=GainFileError,
    version_error=SchemaVersionError,
    again="Design it again with lbt-synth design CONFIG --method METHOD -o FILE.",
)


def require_gain_name(path: str | os.PathLike[str]) -> Path:
    """Refuse a file name that is not that of a gain file."""
    return require_ending(path, "a gain file", READERS)


def save_gain(path: str | os.PathLike[str], design: Design) -> Path:
    """Write a design to a gain file, whole or not at all.

    A FITS file has the controller in its HDUs A, B, C, D, in the new-state
    convention; SPECULA's state-space filter loads it as it is.

    Parameters
    ----------
    path : path-like
        File to write; the ending chooses the format: ``.fits`` or ``.npz``.
    design : Design
        The design.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OutputError
        If the ending is neither, or the file cannot be written.

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
    require_instance(design, Design, "design")
    record = _record_design(design, lbt_synth.__version__)
    try:  # what could not be read back is not written
        require_agreement(record, _record_design(_rebuild(record), lbt_synth.__version__))
    except ValueError as error:
        raise OutputError(f"the design contradicts itself: {error}", path=target) from error
    # A, B, C and D come first, as SPECULA's SsrFilterData loads them
    return _KIND.write(target, record.arrays, record.meta, partial(write_cards, design))


def _record_design(design: Design, version: str) -> DesignRecord:
    """Record a design, as a version of the package writes it."""
    header = DesignRecord(
        meta={
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "library_version": version,
            "convention": CONVENTION,
        }
    )
    return header | record_design(design)


def _rebuild(record: DesignRecord) -> Design:
    """Rebuild the design of a record from its plant, loop and gains, without a certificate."""
    method = method_named(text(record.meta["method"], "method"))
    return rebuild_design(method.kind, record)


def load_gain(path: str | os.PathLike[str]) -> Design:
    """Read a gain file and check it: schema, digest, shapes, finiteness.

    Parameters
    ----------
    path : path-like
        File written by :func:`save_gain`.

    Returns
    -------
    Design
        The design, made again from its plant, loop and gains, and certified again.

    Raises
    ------
    GainFileError
        If the file is missing, damaged or no gain file, if it contradicts its own design, or if
        the design fails its certificate.
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
    design, found = read_design(path)
    try:
        design.certificate.require()
    except CertificateError as error:
        raise GainFileError(
            f"{path} is not verified: {'; '.join(error.failed)}. Try lbt-synth verify, or write it "
            "again with lbt-synth design.",
            path=Path(path),
        ) from error
    return design, found


def read_design(path: str | os.PathLike[str]) -> tuple[Design, str]:
    """Return the design of a gain file with its certificate computed again, and the digest.

    The certificate may have failed; :func:`load_gain` refuses that.
    """
    source = require_ending(path, "a gain file", READERS, GainFileError)
    content, ending = read_bytes(source, GainFileError), source.suffix.lower()
    arrays, meta = _KIND.decode(content, source)
    found = DesignRecord({name: frozen_copy(array) for name, array in arrays.items()}, meta)
    with _KIND.rebuilding(source), np.errstate(all="ignore"):
        for name, array in arrays.items():
            real_array(array, name)
        design, version = _rebuild(found), text(meta["library_version"], "library_version")
        require_agreement(found, _record_design(design, version))
        design = replace(design, certificate=design.recertify())
        if design.certificate.passed:
            require_certificate(meta["certificate"], certificate_record(design.certificate))
            if ending == ".fits":
                cards = {key: value for key, (value, _) in write_cards(design, meta).items()}
                require_same(read_cards(io.BytesIO(content), cards), cards, "header")
    return design, str(meta["digest"])


def require_agreement(found: DesignRecord, expected: DesignRecord) -> None:
    """Refuse a record that lacks something of the expected one, or says something else.

    Entries that no design has are left alone; a certificate is compared by
    :func:`require_certificate`.
    """
    for name, made in expected.arrays.items():
        array = found.arrays[name]
        if array.shape != made.shape:
            raise ValueError(f"{name} must be {made.shape} to match the design; got {array.shape}")
        if not agree(array, made, _ARRAY_TOLERANCE):
            apart = np.max(np.abs(array - made)) / np.max(np.abs([array, made]))
            raise ValueError(
                f"{name} is not what plant, loop and gains make: it differs by {apart:.2g} of the "
                "largest entry"
            )
    for key, value in expected.meta.items():
        if key != "certificate":
            require_same(found.meta[key], value, key)


def require_certificate(stored: list[dict[str, Any]], computed: list[dict[str, Any]]) -> None:
    """Refuse a certificate with other checks than the one computed again.

    The values of the checks are rounding to a large part, and are not compared.
    """
    checks, again = ({check["name"]: check for check in part} for part in (stored, computed))
    if unclaimed := checks.keys() - again.keys():
        raise ValueError(f"the design does not claim what was checked: {min(unclaimed)}")
    if missing := again.keys() - checks.keys():
        raise ValueError(f"the certificate lacks a check of the design: {min(missing)}")
    for name in checks:
        value = number(checks[name]["value"], f"the value of '{name}'")
        require_same(checks[name], again[name] | {"value": value}, f"the check '{name}'")


def require_same(found: Any, expected: Any, name: str) -> None:
    """Refuse plain metadata that are not the expected ones, numbers to a relative 1e-6."""
    if isinstance(expected, Mapping) and isinstance(found, Mapping):
        if unmatched := expected.keys() ^ found.keys():
            word = "missing" if min(unmatched) in expected else "not known"
            raise ValueError(f"{name}.{min(unmatched)} is {word}")
        for key, value in expected.items():
            require_same(found[key], value, f"{name}.{key}")
        return
    if isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            require_same(one, other, f"{name}[{i}]")
        return
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (found, expected))
    same = (
        abs(found - expected) <= _NUMBER_TOLERANCE * abs(expected)
        if numbers
        else type(found) is type(expected) and found == expected
    )
    if not same:
        raise ValueError(f"{name} must be {_brief(expected)} for this design; got {_brief(found)}")


def _brief(value: Any) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
