"""Tables of numbers in text files, with or without a heading, and with gaps."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import TelemetryError
from lbt_synth.validation import FloatArray

_GAPS = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
_DELIMITERS = (";", "\t", ",", "|")
_LOOKED_AT = 20  # rows, to find decimal commas


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TextTable:
    """A table of numbers."""

    names: list[str]  # headings; empty texts without a heading
    values: FloatArray  # (rows, columns), NaN in empty cells
    comments: list[str]  # lines that begin with #, without it
    notes: list[str]


def read_csv(text: str) -> TextTable:
    r"""Read a table of numbers; the delimiter is found.

    Examples
    --------
    >>> from lbt_synth.identification.records.csv_file import read_csv
    >>> table = read_csv("# mode: closed\ntime_s, y_nm\n0.000, 3.5\n0.001, \n")
    >>> table.names, table.values.tolist(), table.comments
    (['time_s', 'y_nm'], [[0.0, 3.5], [0.001, nan]], ['mode: closed'])
    """
    comments, lines, numbers = list[str](), list[str](), list[int]()
    last_comment = ""
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip("\r\n ")
        if not line:
            continue
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip().lstrip("#").strip())
            last_comment = comments[-1] if not lines else last_comment
            continue
        lines.append(line)
        numbers.append(number)
    if not lines:
        raise TelemetryError("it has no rows.")
    sign = _find_delimiter(lines[0])
    notes: list[str] = []
    decimal = (
        sign in {";", "\t"}
        and "," in "".join(lines[1:_LOOKED_AT])
        and all("." not in line for line in lines[1:_LOOKED_AT])
    )
    if decimal:
        notes.append("commas were taken for decimal points")
        lines = [lines[0], *(line.replace(",", ".") for line in lines[1:])]
    first = _split_cells(lines[0], sign)
    heading = any(
        _parse_number(cell.replace(",", ".") if decimal else cell) is None for cell in first
    )
    names = [cell.strip().strip('"') for cell in first] if heading else [""] * len(first)
    if heading:
        lines, numbers = lines[1:], numbers[1:]
    elif decimal:
        lines[0] = lines[0].replace(",", ".")
    if not heading and last_comment:
        above = [cell.strip() for cell in _split_cells(last_comment, sign)]
        if len(above) == len(first) and all(cell and _parse_number(cell) is None for cell in above):
            names = above
    if not lines:
        raise TelemetryError("it has a heading and no rows.")
    return TextTable(
        names=names,
        values=_parse_rows(lines, numbers, sign, len(first)),
        comments=comments,
        notes=notes,
    )


def _find_delimiter(line: str) -> str | None:
    """Return the sign between cells, by the first row; None for blanks or a single column."""
    return next((sign for sign in _DELIMITERS if sign in line), None)


def _split_cells(line: str, sign: str | None) -> list[str]:
    if sign is None:
        return line.split()
    return next(csv.reader(io.StringIO(line), delimiter=sign))


def _parse_number(cell: str) -> float | None:
    word = cell.strip().lower()
    if word in _GAPS:
        return float("nan")
    try:
        return float(word)
    except ValueError:
        return None


def _parse_rows(lines: list[str], numbers: list[int], sign: str | None, width: int) -> FloatArray:
    try:  # the quick way, which knows no gaps
        out = np.loadtxt(lines, delimiter=sign, comments=None, ndmin=2)
        if out.shape == (len(lines), width):
            return np.asarray(out, dtype=np.float64)
    except ValueError:
        pass
    rows = np.empty((len(lines), width))
    for i, (line, number) in enumerate(zip(lines, numbers, strict=True)):
        cells = _split_cells(line, sign)
        if len(cells) != width:
            raise TelemetryError(f"line {number} must have {width} cells; got {len(cells)}.")
        for j, cell in enumerate(cells):
            value = _parse_number(cell)
            if value is None:
                raise TelemetryError(
                    f"cell {j + 1} of line {number} must be a number; got {cell.strip()!r}."
                )
            rows[i, j] = value
    return rows
