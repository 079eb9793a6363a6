"""Tables of numbers in text files, with or without a heading, and with gaps."""

from __future__ import annotations

import csv
from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import TelemetryError
from lbt_synth.validation import FloatArray

_GAPS = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
_DELIMITERS = (";", "\t", ",", "|")  # else blanks
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
    comments, notes = list[str](), list[str]()
    rows: list[tuple[int, str]] = []  # number of each line, from 1, and its text
    above = ""  # the last comment before the table
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip("\r\n ")
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip().lstrip("#").strip())
            above = above if rows else comments[-1]
        elif line:
            rows.append((number, line))
    if not rows:
        raise TelemetryError("it has no rows.")
    sign = next((sign for sign in _DELIMITERS if sign in rows[0][1]), None)
    names = _split_cells(rows[0][1], sign)
    sample = "".join(line for _, line in rows[1:_LOOKED_AT])
    if sign in (";", "\t") and "," in sample and "." not in sample:
        notes.append("commas were taken for decimal points")
        rows = [(number, line.replace(",", ".")) for number, line in rows]
    if None in map(_parse_number, _split_cells(rows[0][1], sign)):
        rows = rows[1:]
    else:
        cells = _split_cells(above, sign)
        is_heading = len(cells) == len(names) and all(
            cell and _parse_number(cell) is None for cell in cells
        )
        names = cells if is_heading else [""] * len(names)
    if not rows:
        raise TelemetryError("it has a heading and no rows.")
    values = _parse_rows(rows, sign, len(names))
    return TextTable(names=names, values=values, comments=comments, notes=notes)


def _split_cells(line: str, sign: str | None) -> list[str]:
    cells = line.split() if sign is None else next(csv.reader([line], delimiter=sign), [])
    return [cell.strip().strip('"') for cell in cells]


def _parse_number(cell: str) -> float | None:
    word = cell.lower()
    try:
        return float("nan" if word in _GAPS else word)
    except ValueError:
        return None


def _parse_rows(rows: list[tuple[int, str]], sign: str | None, width: int) -> FloatArray:
    try:  # the quick way, which knows no gaps
        lines = [line for _, line in rows]
        out = np.loadtxt(lines, delimiter=sign, comments=None, ndmin=2, dtype=np.float64)
        if out.shape == (len(rows), width):
            return out
    except ValueError:
        pass
    out = np.empty((len(rows), width))
    for i, (number, line) in enumerate(rows):
        cells = _split_cells(line, sign)
        if len(cells) != width:
            raise TelemetryError(f"line {number} must have {width} cells; got {len(cells)}.")
        for j, cell in enumerate(cells):
            if (value := _parse_number(cell)) is None:
                raise TelemetryError(
                    f"cell {j + 1} of line {number} must be a number; got {cell!r}."
                )
            out[i, j] = value
    return out
