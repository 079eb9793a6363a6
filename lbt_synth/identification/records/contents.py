"""What a file of series holds: columns and facts of FITS, NPY, NPZ and CSV."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import FileError, LbtSynthError, ProblemError, TelemetryError
from lbt_synth.identification.records.columns import Column, parse_column, recognise_fact
from lbt_synth.identification.records.csv_file import read_csv
from lbt_synth.storage.array_file import error_reason
from lbt_synth.storage.atomic_files import read_bytes, require_ending

FITS = (".fits", ".fit", ".fts")
TEXTS = (".csv", ".tsv", ".txt", ".dat")
ENDINGS = (*FITS, ".npy", ".npz", *TEXTS)
_SUFFIXES = {"frame_rate_hz": "hz", "delay_frames": "frames?", "diameter_m": "m"}  # of numbers
_DELAY_CARD = "DELAY"
_IN_FRAMES = ("[frame]", "[frames]")  # the unit of a card, where the FITS standard has it


@dataclass(slots=True, eq=False)
class Contents:
    """What a file holds."""

    columns: list[Column] = field(default_factory=list)
    # frame rate, delay and the like: values by the places that give them
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add_fact(self, fact: str, value: Any, where: str) -> None:
        """Add a unit, or a number that may be written as a text; note what is none."""
        if fact != "unit":
            suffix = rf"\s*{_SUFFIXES.get(fact, '')}\s*$"
            text = re.sub(suffix, "", value, flags=re.I) if isinstance(value, str) else value
            try:
                value = float(text)
            except (TypeError, ValueError):
                self.notes.append(f"{where} was not taken for {fact}: {value!r} is no number")
                return
        self.facts.setdefault(fact, {})[where] = value

    def add_array(self, name: str, values: npt.NDArray[Any], unit: str | None = None) -> None:
        """Add the columns of an array; leave out what is no series of numbers."""
        said = name or "an array"
        table = np.atleast_1d(np.squeeze(values))
        if values.dtype.kind not in "fiub" or values.size == 0:
            self.notes.append(f"{said} holds no real numbers and was left out")
        elif table.ndim > 2:
            self.notes.append(f"{said} has {table.ndim} dimensions; it was left out")
        elif table.ndim == 1:
            self.columns.append(parse_column(name, table.astype(np.float64), unit=unit))
        else:
            if table.shape[1] > table.shape[0]:
                table = table.T
                said = f"{said} {values.shape}"
                self.notes.append(f"{said}: its longer side was taken for the frames")
            base = parse_column(name, np.empty(0), unit=unit)
            for axis, column in enumerate(table.T.astype(np.float64)):
                self.columns.append(replace(base, name=f"{name}[{axis}]", values=column, axis=axis))


@contextmanager
def name_in_errors(path: Path) -> Iterator[None]:
    """Name a file in the errors that do not name it yet."""
    try:
        yield
    except FileError as error:
        if error.path is not None:
            raise
        raise type(error)(f"{path}: {error}", path=path) from error
    except ProblemError as error:
        raise type(error)(f"{path}: {error}") from error


def read_record_bytes(path: Path) -> bytes:
    """Return the content of a file of series."""
    return read_bytes(require_ending(path, "a record", ENDINGS, TelemetryError), TelemetryError)


def read_contents(path: Path) -> Contents:
    """Return what a file holds."""
    return parse_contents(path, read_record_bytes(path))


def parse_contents(path: Path, content: bytes) -> Contents:
    """Return what the content of a file holds."""
    ending, out = path.suffix.lower(), Contents()
    read = {**dict.fromkeys(FITS, _read_fits), ".npy": _read_npy, ".npz": _read_npz}
    with name_in_errors(path):
        try:
            read.get(ending, _read_text)(out, content)
        except LbtSynthError:
            raise
        except Exception as error:  # foreign bytes: the decoders raise whatever they like
            raise TelemetryError(
                f"cannot read {path} as {ending}: {error_reason(error)}.", path=path
            ) from error
    return out


def _read_fits(out: Contents, content: bytes) -> None:
    from astropy.io import fits

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # foreign headers deviate in many small ways
        for damage in (".*truncated.*", ".*Error validating header.*"):
            warnings.filterwarnings("error", message=damage)
        # without uint, gaps of shifted integers become NaN as well
        with fits.open(io.BytesIO(content), memmap=False, uint=False) as units:
            for place, unit in enumerate(units):
                name = unit.name if unit.name and unit.name != "PRIMARY" else ""
                for card in unit.header.cards:
                    _add_card(out, card, name or f"HDU {place}")
                if isinstance(unit, fits.BinTableHDU | fits.TableHDU):
                    _add_table(out, unit)
                elif unit.is_image and unit.data is not None:
                    own = unit.header.get("BUNIT")
                    out.add_array(name, unit.data, None if own is None else str(own))


def _add_card(out: Contents, card: Any, where: str) -> None:
    fact = recognise_fact(str(card.keyword))
    if card.keyword == _DELAY_CARD:
        if card.comment.lower().startswith(_IN_FRAMES):
            fact = "delay_frames"
        else:
            out.notes.append(
                f"{_DELAY_CARD} of the header was not taken: its comment does not say that it is "
                "in frames, as [frames] does"
            )
    if fact not in (None, "unit") and not isinstance(card.value, bool):
        out.add_fact(fact, card.value, f"{card.keyword} of {where}")


def _add_table(out: Contents, unit: Any) -> None:
    stored = unit.data.view(np.ndarray)  # before scaling, as the null of a column is
    for card in unit.columns:
        data, raw = np.asarray(unit.data[card.name]), stored[card.name]
        if raw.dtype.kind == "S":
            raw = np.char.strip(raw.astype(str))
        if card.null not in (None, "") and raw.shape == data.shape:
            data = np.where(raw == card.null, np.nan, data)
        out.add_array(card.name, data, card.unit)


def _read_npy(out: Contents, content: bytes) -> None:
    if not content.startswith(b"\x93NUMPY"):
        raise ValueError("it does not begin as an NPY file does; it is damaged, or another kind")
    _add_named(out, "", np.asarray(np.load(io.BytesIO(content), allow_pickle=False)))


def _read_npz(out: Contents, content: bytes) -> None:
    if not is_zipfile(io.BytesIO(content)):
        raise ValueError("it is no ZIP archive; it is damaged, or of another kind")
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        for name in archive.files:
            _add_named(out, name, np.asarray(archive[name]))


def _add_named(out: Contents, name: str, array: npt.NDArray[Any]) -> None:
    """Add an array, each field of a structured one, or a number or text as a fact."""
    fact = recognise_fact(name)
    if array.dtype.names:
        for each in array.dtype.names:
            out.add_array(each, array[each])
    elif array.size == 1 and (array.ndim == 0 or array.dtype.kind in "US" or fact is not None):
        if fact is None:
            out.notes.append(f"not used: {name}, a single value")
        else:
            out.add_fact(fact, array.item(), name)
    else:
        out.add_array(name, array)


def _read_text(out: Contents, content: bytes) -> None:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TelemetryError("it is no text in UTF-8.") from error
    table = read_csv(text)
    out.notes += table.notes
    out.columns = [parse_column(n, v) for n, v in zip(table.names, table.values.T, strict=True)]
    for line in table.comments:  # such as frame_rate_hz = 1000
        match = re.match(r"^\s*([A-Za-z][\w .\-]*?)\s*[:=]\s*(\S.*?)\s*$", line)
        if match is None or (fact := recognise_fact(match[1])) is None:
            continue
        where = f"the comment {match[1].strip()}"
        if fact == "unit" and " " in match[2]:
            out.notes.append(f"{where} was not taken for a unit: {match[2]!r}")
        else:
            out.add_fact(fact, match[2], where)
