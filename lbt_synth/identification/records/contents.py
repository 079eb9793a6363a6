"""What a file of series holds: columns and facts of FITS, NPY, NPZ and text tables."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import FileError, LbtSynthError, ProblemError, TelemetryError
from lbt_synth.identification.records.columns import Column, parse_column, recognise_fact
from lbt_synth.storage.array_file import error_reason, open_fits, read_numpy
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import FloatArray

FITS = (".fits", ".fit", ".fts")
TEXTS = (".csv", ".tsv", ".txt", ".dat")
ENDINGS = (*FITS, ".npy", ".npz", *TEXTS)
_SUFFIXES = {  # of numbers that are texts
    "frame_rate_hz": ("hz",),
    "delay_frames": ("frames", "frame"),
    "diameter_m": ("m",),
}
_GAPS = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
_DELIMITERS = (";", "\t", ",", "|")  # else blanks
_LOOKED_AT = 20  # rows, to find decimal commas
_DELAY_CARD = "DELAY"
_IN_FRAMES = ("[frame]", "[frames]")  # the unit of a card, where the FITS standard has it


@dataclass(slots=True, eq=False)
class Contents:
    """What a file holds."""

    columns: list[Column] = field(default_factory=list)
    # frame rate, delay and the like: values by the places that give them
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)  # arrays that are no series, and why

    def add_fact(self, fact: str, value: Any, where: str) -> None:
        """Add a unit, or a number that may be written as a text; note what is none."""
        if fact != "unit":
            try:
                value = _parse_fact(fact, value) if isinstance(value, str) else float(value)
            except (TypeError, ValueError):
                self.notes.append(f"{where} was not taken for {fact}: {value!r} is no number")
                return
        self.facts.setdefault(fact, {})[where] = value

    def add_array(self, name: str, values: npt.NDArray[Any], unit: str | None = None) -> None:
        """Add the columns of an array; leave out what is no series of numbers."""
        said = name or "an array"
        table = np.atleast_1d(np.squeeze(values))
        if values.dtype.kind not in "fiub" or values.size == 0:
            self.left_out.append(f"{said} holds no real numbers")
        elif table.ndim > 2:
            self.left_out.append(f"{said} has {table.ndim} dimensions")
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


def _parse_fact(fact: str, text: str) -> float:
    word = text.strip().lower()
    for suffix in _SUFFIXES.get(fact, ()):
        word = word.removesuffix(suffix)
    return float(word)


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


def read_contents(path: Path) -> Contents:
    """Return what a file holds."""
    require_ending(path, "a record", ENDINGS, TelemetryError)
    return parse_contents(path, read_bytes(path, TelemetryError))


def parse_contents(path: Path, content: bytes) -> Contents:
    """Return what the content of a file holds."""
    ending, out = path.suffix.lower(), Contents()
    read = {**dict.fromkeys(FITS, _read_fits), ".npy": _read_numpy, ".npz": _read_numpy}
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

    with open_fits(content, uint=False) as units:  # gaps of shifted integers become NaN
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


def _read_numpy(out: Contents, content: bytes) -> None:
    for name, array in read_numpy(content).items():
        _add_named(out, name, array)


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
        raise TelemetryError("it is not UTF-8 text.") from error
    rows: list[tuple[int, str]] = []  # number of each line, from 1, and its text
    above = ""  # the last comment before the table, which may have the names
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip("\r\n ")
        if line.lstrip().startswith("#"):
            comment = line.lstrip().lstrip("#").strip()
            above = above if rows else comment
            _add_comment(out, comment)
        elif line:
            rows.append((number, line))
    if not rows:
        raise TelemetryError("it has no rows.")
    sign = next((sign for sign in _DELIMITERS if sign in rows[0][1]), None)
    names = _split_heading(rows[0][1], sign)
    sample = "".join(line for _, line in rows[1:_LOOKED_AT])
    if sign in (";", "\t") and "," in sample and "." not in sample:
        out.notes.append("commas were taken for decimal points")
        rows = [(number, line.replace(",", ".")) for number, line in rows]
    if None in map(_parse_number, _split_heading(rows[0][1], sign)):
        rows = rows[1:]
    else:
        cells = _split_heading(above, sign)
        numbers = [cell for cell in cells if not cell or _parse_number(cell) is not None]
        names = [""] * len(names) if numbers or len(cells) != len(names) else cells
    if not rows:
        raise TelemetryError("it has a heading and no rows.")
    table = _parse_rows(rows, sign, len(names))
    out.columns = [parse_column(name, column) for name, column in zip(names, table.T, strict=True)]


def _add_comment(out: Contents, comment: str) -> None:
    """Add the fact of a comment such as frame_rate_hz = 1000."""
    sign = min((at for at in map(comment.find, ":=") if at > 0), default=0)
    key, value = comment[:sign].strip(), comment[sign + 1 :].strip()
    if value and (fact := recognise_fact(key)) is not None:
        if fact == "unit" and " " in value:
            out.notes.append(f"the comment {key} was not taken for a unit: {value!r}")
        else:
            out.add_fact(fact, value, f"the comment {key}")


def _split_cells(lines: Iterable[str], sign: str | None) -> Iterator[list[str]]:
    """Yield the cells of each line."""
    return map(str.split, lines) if sign is None else csv.reader(lines, delimiter=sign)


def _split_heading(line: str, sign: str | None) -> list[str]:
    return [cell.strip().strip('"') for cell in next(_split_cells([line], sign), [])]


def _parse_number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return float("nan") if cell.strip().lower() in _GAPS else None


def _parse_rows(rows: list[tuple[int, str]], sign: str | None, width: int) -> FloatArray:
    lines, out = [line for _, line in rows], np.empty((len(rows), width))
    with suppress(ValueError):  # the quick way, which knows no gaps
        found = np.loadtxt(lines, delimiter=sign, comments=None, ndmin=2, dtype=np.float64)
        if found.shape == out.shape:
            return found
    table = _split_cells(lines, sign)
    for values, (number, _), cells in zip(out, rows, table, strict=True):
        parsed = list(map(_parse_number, cells))
        if len(parsed) != width:
            raise TelemetryError(f"line {number} must have {width} cells; got {len(parsed)}.")
        if None in parsed:
            at = parsed.index(None)
            raise TelemetryError(
                f"cell {at + 1} of line {number} must be a number; got {cells[at].strip()!r}."
            )
        values[:] = parsed
    return out
