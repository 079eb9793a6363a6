"""What a file of series holds, and which of its columns make a record.

Columns and facts come from FITS, NPY, NPZ and text tables.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import FileError, LbtSynthError, ProblemError, TelemetryError
from lbt_synth.identification.records.columns import (
    OF_AXES,
    ROLES,
    Column,
    parse_column,
    recognise_fact,
)
from lbt_synth.storage.array_file import error_reason, open_fits, read_numpy
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import choice, integer, sequence

FITS = (".fits", ".fit", ".fts")
TEXTS = (".csv", ".tsv", ".txt", ".dat")
ENDINGS = (*FITS, ".npy", ".npz", *TEXTS)
_GAPS = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
_DELIMITERS = (";", "\t", ",", "|")  # else blanks
KINDS = {  # and the roles that make a record of each, the first that of its series
    "closed_loop": ("measurements", "commands"),
    "open_loop": ("open_loop",),
    "spectrum": ("density", "frequency"),
}
CLOCKS = ("frame_numbers", "times")

Roles = dict[str, list[Column]]


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
    """Return the number of a text, which may have the unit that the name of the fact ends with."""
    return float(text.strip().lower().removesuffix(fact.rpartition("_")[2]))


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
    content, ending, out = read_bytes(path, TelemetryError), path.suffix.lower(), Contents()
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
                fact = recognise_fact(str(card.keyword))
                if fact not in (None, "unit") and not isinstance(card.value, bool):
                    out.add_fact(fact, card.value, f"{card.keyword} of {name or f'HDU {place}'}")
            if isinstance(unit, fits.BinTableHDU | fits.TableHDU):
                _add_table(out, unit)
            elif unit.is_image and unit.data is not None:
                out.add_array(name, unit.data, str(unit.header.get("BUNIT", "")) or None)


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
    """Add arrays, each field of structured ones, and single numbers and texts as facts."""
    for name, array in read_numpy(content).items():
        fact = recognise_fact(name)
        if array.dtype.names:
            for field_name in array.dtype.names:
                out.add_array(field_name, array[field_name])
        elif array.size == 1 and fact is not None:
            out.add_fact(fact, array.item(), name)
        elif array.ndim == 0 or (array.size == 1 and array.dtype.kind in "US"):
            out.notes.append(f"not used: {name}, a single value")
        else:
            out.add_array(name, array)


def _read_text(out: Contents, content: bytes) -> None:
    """Add the columns of a text table, and the facts in its comments."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TelemetryError("it is not UTF-8 text.") from error
    lines = [(n, line.strip("\r\n ")) for n, line in enumerate(text.splitlines(), start=1)]
    rows = [(n, line) for n, line in lines if line and line[0] != "#"]
    if not rows:
        raise TelemetryError("it has no rows.")
    comments = [(n, line.lstrip("#").strip()) for n, line in lines if line[:1] == "#"]
    for _, comment in comments:
        _add_comment(out, comment)
    sign = next((sign for sign in _DELIMITERS if sign in rows[0][1]), None)
    sample = "".join(line for _, line in rows[1:20])
    if sign in (";", "\t") and "," in sample and "." not in sample:
        out.notes.append("commas were taken for decimal points")
        rows = [(n, line.replace(",", ".")) for n, line in rows]
    names = _split_cells(rows[0][1], sign)
    if None in map(_parse_number, names):
        rows = rows[1:]
        if not rows:
            raise TelemetryError("it has a heading and no rows.")
    else:  # the last comment before the table may have the names
        above = _split_cells(next((c for n, c in comments[::-1] if n < rows[0][0]), ""), sign)
        named = len(above) == len(names) and all(c and _parse_number(c) is None for c in above)
        names = above if named else [""] * len(names)
    _add_rows(out, rows, names, sign)


def _add_rows(
    out: Contents, rows: list[tuple[int, str]], names: list[str], sign: str | None
) -> None:
    """Add the columns of numbered rows; leave out those of texts that no role needs."""
    lines, columns = [line for _, line in rows], [parse_column(name, np.empty(0)) for name in names]
    table = [line.split() for line in lines] if sign is None else csv.reader(lines, delimiter=sign)
    cells = []
    for (n, _), row in zip(rows, table, strict=True):
        if len(row) != len(names):
            raise TelemetryError(f"line {n} must have {len(names)} cells; got {len(row)}.")
        cells.append(row)
    for at, (column, texts) in enumerate(zip(columns, zip(*cells, strict=True), strict=True)):
        values = [_parse_number(text) for text in texts]
        if None not in values:
            out.columns.append(replace(column, values=np.array(values, dtype=np.float64)))
        elif column.name and column.role is None:  # as a remark or a date
            out.left_out.append(f"{column.name} holds texts")
        else:
            bad = values.index(None)
            raise TelemetryError(
                f"cell {at + 1} of line {rows[bad][0]} must be a number; got "
                f"{texts[bad].strip()!r}."
            )


def _add_comment(out: Contents, comment: str) -> None:
    """Add the fact of a comment such as frame_rate_hz = 1000."""
    sign = min((at for at in map(comment.find, ":=") if at > 0), default=0)
    key, value = comment[:sign].strip(), comment[sign + 1 :].strip()
    if value and (fact := recognise_fact(key)) is not None:
        if fact == "unit" and " " in value:
            out.notes.append(f"the comment {key} was not taken for a unit: {value!r}")
        else:
            out.add_fact(fact, value, f"the comment {key}")


def _split_cells(line: str, sign: str | None) -> list[str]:
    """Return the cells of a line."""
    cells = line.split() if sign is None else next(csv.reader([line], delimiter=sign), [])
    return [cell.strip().strip('"') for cell in cells]


def _parse_number(cell: str) -> float | None:
    """Return the number in a cell, nan of a gap, None of a text."""
    try:
        return float(cell)
    except ValueError:
        return float("nan") if cell.strip().lower() in _GAPS else None


def select_series(
    contents: Contents,
    *,
    kind: str | None,
    axes: Sequence[int] | None,
    columns: Mapping[str, Any] | None,
) -> tuple[str, Roles]:
    """Choose the columns of a record, and note which; return its kind and them by their roles.

    Those of a role with axes are in the order of the axes, of another role there is one; the first
    role is that of the measurements or densities.
    """
    notes = contents.notes
    notes += [f"{why}; it was left out" for why in contents.left_out]
    if not contents.columns:
        raise ProblemError(f"the file holds no series of numbers{_left_out(contents)}.")
    roles = _assign_roles(contents.columns, columns) or _assign_by_kind(contents, kind)
    kind = _find_kind(roles, contents) if kind is None else kind
    if kind == "open_loop" and "open_loop" not in roles and "measurements" in roles:
        series = roles["measurements"]
        named = len({column.axis for column in series} - {None}) == len(series)
        roles["open_loop"] = number_axes(series) if _are_axes(series) and not named else series
    needed = KINDS[kind]
    if not all(role in roles for role in needed):
        raise ProblemError(
            f"a record of kind {kind} needs columns of {' and '.join(needed)}"
            + _how_to_choose(contents, *needed)
        )
    clocks = [role for role in CLOCKS if role in roles and kind != "spectrum"]
    chosen = {role: _choose_columns(roles[role], role, axes) for role in [*needed, *clocks]}
    notes += [f"{role.replace('_', ' ')}: {join_names(of)}" for role, of in chosen.items()]
    used = {id(column.values) for of in chosen.values() for column in of}
    if unused := [column for column in contents.columns if id(column.values) not in used]:
        notes.append(f"not used: {join_names(unused)}")
    if kind == "open_loop" and "commands" in roles:
        notes.append("commands were left out: the record is of an open loop")
    return kind, chosen


def number_axes(columns: Sequence[Column]) -> list[Column]:
    """Return columns numbered as axes, in their order."""
    return [replace(column, axis=axis) for axis, column in enumerate(columns)]


def _assign_roles(columns: Sequence[Column], chosen: Mapping[str, Any] | None) -> Roles:
    """Return the columns of each role: those that were chosen, then by names."""
    chosen = {} if chosen is None else chosen
    if not isinstance(chosen, Mapping):
        raise ProblemError(
            "columns must be a mapping such as {'measurements': ('a', 'b')}; got "
            f"{type(chosen).__name__}."
        )
    out: Roles = {}
    for role, wanted in chosen.items():
        choice(role, "a key of columns", tuple(ROLES))
        keys = (wanted,) if isinstance(wanted, str | int) else sequence(wanted, "columns")
        out[role] = number_axes([hit for key in keys for hit in _find_columns(columns, key)])
    taken = [id(column.values) for of in out.values() for column in of]
    if len(set(taken)) < len(taken):
        raise ProblemError("a column was chosen twice in columns.")
    for column in columns:
        if column.role is not None and column.role not in chosen and id(column.values) not in taken:
            out.setdefault(column.role, []).append(column)
    return {role: of for role, of in out.items() if of}


def _find_columns(columns: Sequence[Column], wanted: Any) -> list[Column]:
    """Find the columns of a name, all of an array, or of a number."""
    if isinstance(wanted, str):
        name = wanted.strip().lower()
        hits = [column for column in columns if column.name.strip().lower() == name]
        if len(hits) > 1:
            raise ProblemError(f"{len(hits)} columns are named {wanted!r}; choose by numbers.")
        hits = hits or [column for column in columns if column.name.lower().startswith(f"{name}[")]
        if not hits:
            raise ProblemError(f"there is no column {wanted!r}; got {join_names(columns)}.")
        return hits
    number = integer(wanted, "a number of columns", at_least=0)
    if number >= len(columns):
        raise ProblemError(f"there is no column {number}; the file has {len(columns)}, from 0.")
    return [columns[number]]


def _assign_by_kind(contents: Contents, kind: str | None) -> Roles:
    """Return the roles of columns that only the kind of the record tells."""
    columns = contents.columns
    if kind == "spectrum" and len(columns) > 1:
        contents.notes.append(
            "the first column was taken for the frequencies, the others for densities"
        )
        return {"frequency": [columns[0]], "density": number_axes(columns[1:])}
    if kind == "open_loop" and (len(columns) == 1 or _are_axes(columns)):
        return {"open_loop": number_axes(columns)}
    return {}


def _are_axes(columns: Sequence[Column]) -> bool:
    """Return whether two columns are the series of two axes: none rises all the time as a clock."""
    return len(columns) == 2 and not any(np.all(np.diff(column.values) > 0) for column in columns)


def _find_kind(roles: Roles, contents: Contents) -> str:
    """Return the kind of record that the names tell."""
    kinds = [kind for kind, needed in KINDS.items() if all(role in roles for role in needed)]
    if len(kinds) == 1:
        return kinds[0]
    if kinds:
        raise ProblemError(f"the file holds more than one record; say kind: {' or '.join(kinds)}.")
    if "measurements" in roles:
        raise ProblemError(
            "the file has measurements and no commands. Residuals of a closed loop need its "
            "commands: give the file that has them, or choose their columns. If the loop was "
            "open, or the series is of the pseudo-open loop, say kind open_loop."
        )
    raise ProblemError(
        "names do not tell what the columns are"
        + _how_to_choose(contents, "measurements", "commands")
        + " Or say what kind the record is."
    )


def _choose_columns(columns: list[Column], role: str, axes: Sequence[int] | None) -> list[Column]:
    """Return the columns of the axes, in the order that their names tell."""
    of_axes = role in OF_AXES
    named_axes = {column.axis for column in columns if column.axis is not None and of_axes}
    if len(columns) > 1 and len(named_axes) < len(columns):
        raise ProblemError(
            f"{join_names(columns)} are all named as {role}"
            f"{', and not each of an axis of its own' if of_axes else ''}; choose by "
            f"columns={{'{role}': ...}}."
        )
    if not of_axes:
        return columns
    ordered = sorted(columns, key=lambda column: column.axis or 0)
    return [ordered[i] for i in choose_axes(axes, len(columns), f"columns of {role}")]


def choose_axes(axes: Sequence[int] | None, count: int, what: str) -> list[int]:
    """Return the numbers of one or two axes among some series: those given, or all."""
    if axes is None and count <= 2:
        return list(range(count))
    if axes is None:
        raise ProblemError(
            f"there are {count} {what}; say which are tip and tilt: axes=(0, 1) for the first two."
        )
    chosen = [integer(axis, "axes", at_least=0) for axis in sequence(axes, "axes")]
    if not 1 <= len(chosen) <= 2 or len(set(chosen)) < len(chosen) or max(chosen) >= count:
        raise ProblemError(
            f"axes must be one or two different numbers below {count}, the number of {what}; got "
            f"{chosen}."
        )
    return chosen


def join_names(columns: Sequence[Column]) -> str:
    """Return the names of columns in one text."""
    return ", ".join(column.name or "a column without a name" for column in columns)


def _left_out(contents: Contents) -> str:
    """Return which arrays were left out, and why, to go on in a sentence."""
    return f" ({'; '.join(contents.left_out)})" if contents.left_out else ""


def _how_to_choose(contents: Contents, *roles: str) -> str:
    """Return which columns there are, and how to choose, as the end of a sentence."""
    wanted = ", ".join(f"'{role}': ..." for role in roles)
    return (
        f"; got {join_names(contents.columns)}{_left_out(contents)}. Choose by "
        f"columns={{{wanted}}}, names or numbers from 0."
    )
