"""What a file of series holds: columns and facts of FITS, NPY, NPZ and CSV."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import TelemetryError
from lbt_synth.identification.records.columns import (
    Column,
    array_columns,
    pair_x_and_y,
    parse_column,
    recognise_fact,
)
from lbt_synth.identification.records.csv_file import read_csv
from lbt_synth.storage.array_file import error_reason
from lbt_synth.validation import FloatArray

FITS = (".fits", ".fit", ".fts")
TEXTS = (".csv", ".tsv", ".txt", ".dat")
ENDINGS = (*FITS, ".npy", ".npz", *TEXTS)
_DELAY_CARD = "DELAY"
_SUFFIXES = {  # what may follow a number in a text
    "frame_rate_hz": r"\s*hz$",
    "delay_frames": r"\s*frames?$",
    "diameter_m": r"\s*m$",
}
_IN_FRAMES = re.compile(r"[\[(]\s*frames?\s*[\])]|^[^\[(]*\bin frames\b|^\s*frames\s*$", re.I)


@dataclass(slots=True, eq=False)
class Contents:
    """What a file holds."""

    columns: list[Column] = field(default_factory=list)
    # frame rate, delay and the like: values by the places that give them
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add_fact(self, fact: str, value: Any, where: str) -> None:
        """Add a fact that a place of the file gives."""
        self.facts.setdefault(fact, {})[where] = value

    def add_number(self, fact: str, value: Any, where: str) -> None:
        """Add a number that may be written as a text, or note that it is none."""
        if isinstance(value, str) and fact in _SUFFIXES:
            value = re.sub(_SUFFIXES[fact], "", value.strip(), flags=re.I)
        try:
            self.add_fact(fact, float(value), where)
        except (TypeError, ValueError):
            self.notes.append(f"{where} was not taken for {fact}: {value!r} is no number")

    def add_array(self, name: str, values: npt.NDArray[Any], unit: str | None = None) -> None:
        """Add the columns of an array; leave out what is no series of numbers."""
        if values.dtype.kind not in "fiub" or values.size == 0:
            self.notes.append(f"{name or 'an array'} holds no real numbers and was left out")
            return
        table = np.squeeze(values) if values.size > 1 else values.reshape(1)
        if table.ndim not in (1, 2):
            self.notes.append(f"{name or 'an array'} has {table.ndim} dimensions; it was left out")
            return
        numbers: FloatArray = np.asarray(table, dtype=np.float64)
        if numbers.ndim == 1:
            numbers = numbers[:, None]
        elif numbers.shape[1] > numbers.shape[0]:
            numbers = numbers.T
            said = f"{name or 'the array'} {values.shape}: its longer side was taken for the frames"
            self.notes.append(said)
        self.columns += array_columns(name, numbers, unit=unit)


def read_contents(path: Path, content: bytes) -> Contents:
    """Read a file of a known ending."""
    ending = path.suffix.lower()
    reader = {**dict.fromkeys(FITS, _read_fits), ".npy": _read_npy, ".npz": _read_npz}.get(
        ending, _read_text
    )
    try:
        out = reader(content)
        out.columns = pair_x_and_y(out.columns)
    except TelemetryError as error:
        raise TelemetryError(f"{path}: {error}", path=path) from error
    except Exception as error:  # foreign bytes: the decoders raise whatever they like
        raise TelemetryError(
            f"cannot read {path} as {ending}: {error_reason(error)}.", path=path
        ) from error
    return out


def _read_fits(content: bytes) -> Contents:
    from astropy.io import fits

    out = Contents()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # foreign headers deviate in many small ways
        for damage in (".*truncated.*", ".*Error validating header.*"):
            warnings.filterwarnings("error", message=damage)
        with fits.open(io.BytesIO(content), memmap=False) as units:
            for place, unit in enumerate(units):
                name = unit.name if unit.name and unit.name != "PRIMARY" else ""
                where = name or f"HDU {place}"
                for card in unit.header.cards:
                    _add_card(out, card, where)
                if isinstance(unit, fits.BinTableHDU | fits.TableHDU):
                    _add_table(out, unit)
                elif unit.is_image and unit.data is not None:
                    own, blank = unit.header.get("BUNIT"), unit.header.get("BLANK")
                    zero = float(unit.header.get("BZERO", 0.0))  # reading the data drops it
                    data = _native_order(unit.data)
                    if blank is not None and data.dtype.kind in "iu":
                        data = np.where(data == blank + zero, np.nan, data)
                    out.add_array(name, data, str(own) if own is not None else None)
    return out


def _add_card(out: Contents, card: Any, where: str) -> None:
    keyword = str(card.keyword)
    fact = recognise_fact(keyword)
    if keyword == _DELAY_CARD and _IN_FRAMES.search(str(card.comment)):
        fact = "delay_frames"
    elif keyword == _DELAY_CARD:
        out.notes.append("DELAY of the header was not taken: it does not say that it is in frames")
    if fact is not None and fact != "unit" and not isinstance(card.value, bool):
        out.add_number(fact, card.value, f"{keyword} of {where}")


def _add_table(out: Contents, unit: Any) -> None:
    for card in unit.columns:
        data = _native_order(np.asarray(unit.data[card.name]))
        if card.null is not None and data.dtype.kind in "iuf":
            scale, zero = (
                default if each in (None, "") else float(each)
                for each, default in ((card.bscale, 1.0), (card.bzero, 0.0))
            )
            null = scale * float(card.null) + zero  # the card has it before scaling
            data = np.where(np.abs(data - null) < 0.25 * abs(scale), np.nan, data)
        out.add_array(card.name, data, card.unit)


def _native_order(data: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return data.astype(data.dtype.newbyteorder("="))


def _read_npy(content: bytes) -> Contents:
    out = Contents()
    if not content.startswith(b"\x93NUMPY"):
        raise ValueError("it does not begin as an NPY file does; it is damaged, or another kind")
    _add_named(out, "", np.asarray(np.load(io.BytesIO(content), allow_pickle=False)))
    return out


def _read_npz(content: bytes) -> Contents:
    out = Contents()
    if not is_zipfile(io.BytesIO(content)):
        raise ValueError("it is no ZIP archive; it is damaged, or of another kind")
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        for name in archive.files:
            _add_named(out, name, np.asarray(archive[name]))
    return out


def _add_named(out: Contents, name: str, array: npt.NDArray[Any]) -> None:
    """Add an array, each field of a structured one, or a number or text as a fact."""
    if array.dtype.names:
        for each in array.dtype.names:
            out.add_array(each, array[each])
        return
    fact, text = recognise_fact(name), array.dtype.kind in "US"
    if array.size == 1 and (array.ndim == 0 or text or fact is not None):
        value = array.reshape(-1)[0]
        if fact == "unit":
            out.add_fact(fact, str(value), name)
        elif fact is not None:
            out.add_number(fact, value, name)
        else:
            out.notes.append(f"not used: {name}, a single value")
        return
    out.add_array(name, array)


def _read_text(content: bytes) -> Contents:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TelemetryError("it is no text in UTF-8.") from error
    table = read_csv(text)
    out = Contents(notes=list(table.notes))
    out.columns = [parse_column(n, v) for n, v in zip(table.names, table.values.T, strict=True)]
    _add_comments(out, table.comments)
    return out


def _add_comments(out: Contents, comments: Iterable[str]) -> None:
    """Read lines such as ``# frame_rate_hz = 1000``."""
    for line in comments:
        match = re.match(r"^\s*([A-Za-z][\w .\-]*?)\s*[:=]\s*(\S.*?)\s*$", line)
        if match is None or (fact := recognise_fact(match[1])) is None:
            continue
        where = f"the comment {match[1].strip()}"
        if fact == "unit" and " " in match[2]:
            out.notes.append(f"{where} was not taken for a unit: {match[2]!r}")
        elif fact == "unit":
            out.add_fact(fact, match[2], where)
        else:
            out.add_number(fact, match[2], where)
