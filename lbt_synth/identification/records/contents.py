"""What a file of series holds, and which of its columns make a record.

A reader for each format adds columns and facts: FITS, NumPy, text tables, HDF5, MATLAB and IDL.
Names of structures and groups stand before those of their arrays, as in ``rec.y`` and ``night/y``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
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
from lbt_synth.storage import array_file
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import choice, integer, number, sequence

FITS = (".fits", ".fit", ".fts")
_DELIMITERS = (";", "\t", ",", "|")  # else blanks
# the roles that make a record: of a closed loop, of an open one, of a spectrum
_KINDS = (("measurements", "commands"), ("open_loop",), ("density", "frequency"))
CLOCKS = ("frame_numbers", "times")
_ARRAY = re.compile(r".*\[(?=\d+\]$)")  # of which a name such as y[0] says that it is a column

_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:e[-+]?\d+)?", re.IGNORECASE)

Roles = dict[str, list[Column]]


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
            try:
                if isinstance(value, str):  # perhaps with the unit that ends the name of the fact
                    value = value.strip().lower().removesuffix(fact.rpartition("_")[2])
                value = float(value)
            except (TypeError, ValueError):
                self.notes.append(f"{where} was not taken for {fact}: {value!r} is no number")
                return
        self.facts.setdefault(fact, {})[where] = value

    def find_fact(self, name: str, stated: Any) -> Any:
        """Return what the call states, else what the file has; refuse two values of a file."""
        places = self.facts.get(name, {})
        values = {where: number(value, f"{where} ({name})") for where, value in places.items()}
        listing = ", ".join(f"{value:.9g} by {where}" for where, value in values.items())
        if stated is None and len(set(values.values())) > 1:
            raise ProblemError(f"the file gives {name} twice: {listing}. Choose one in the call.")
        if stated is None and values:
            stated = next(iter(values.values()))
            self.notes.append(f"{name} {listing}")
            return int(stated) if name == "averages" else stated
        if values and not np.allclose([*values.values()], number(stated, name), rtol=1e-6, atol=0):
            self.notes.append(f"{name} {stated:.9g} was given, in place of {listing}")
        return stated

    def add_array(
        self, name: str, values: npt.NDArray[Any], unit: str | None = None, *, group: str = ""
    ) -> None:
        """Add the columns of an array of a group; leave out what is no series of numbers."""
        said = f"{group}{name}" or "an array"
        table = np.atleast_1d(np.squeeze(values))
        if values.dtype.kind not in "fiub" or values.size == 0 or table.ndim > 2:
            self.notes.append(f"{said} is no series of real numbers; it was left out")
        elif table.ndim == 1:
            column = parse_column(name, table.astype(np.float64), unit=unit)
            self.columns.append(replace(column, name=f"{group}{name}"))
        else:
            if table.shape[1] > table.shape[0]:
                table = table.T
                said = f"{said} {values.shape}"
                self.notes.append(f"{said}: its longer side was taken for the frames")
            base = parse_column(name, np.empty(0), unit=unit)
            for axis, column in enumerate(table.T.astype(np.float64)):
                title = f"{group}{name}[{axis}]"
                self.columns.append(replace(base, name=title, values=column, axis=axis))


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
    require_ending(path, "a record", _READERS, TelemetryError)
    content, ending, out = read_bytes(path, TelemetryError), path.suffix.lower(), Contents()
    with name_in_errors(path):
        try:
            _READERS[ending](out, content)
            _join_seconds(out)
        except LbtSynthError:
            raise
        except Exception as error:  # foreign bytes: the decoders raise whatever they like
            raise TelemetryError(
                f"cannot read {path} as {ending}: {array_file.error_reason(error)}.", path=path
            ) from error
    return out


def _join_seconds(out: Contents) -> None:
    """Make times of the seconds and microseconds of ESO's SPARTA, which stand in two columns."""
    named = {column.name.lower(): column for column in out.columns}
    if {"seconds", "useconds"} <= named.keys():
        second, micro = named["seconds"], named["useconds"]
        values, name = second.values + 1e-6 * micro.values, f"{second.name} + {micro.name}"
        out.columns[out.columns.index(second)] = replace(second, name=name, values=values, unit="s")
        out.columns.remove(micro)


def _add_named(
    out: Contents, name: str, value: Any, *, group: str = "", unit: str | None = None
) -> None:
    """Add an array, all that is in a structure, or a single number or text that is a fact."""
    if isinstance(value, np.ndarray) and value.dtype.names:
        value = {key: value[key] for key in value.dtype.names}
    if isinstance(value, Mapping):
        for key, member in value.items():
            if not key.startswith("__"):  # as MATLAB's own names do
                _add_named(out, key, member, group=f"{group}{name}." if name else group)
        return
    array, fact = np.asarray([] if isinstance(value, list) else value), recognise_fact(name)
    if array.size == 1 and isinstance(item := array.item(), np.ndarray):  # as IDL nests them
        _add_named(out, name, item, group=group)
    elif array.size == 1 and fact is not None:
        out.add_fact(fact, item.decode() if isinstance(item, bytes) else item, f"{group}{name}")
    elif array.ndim == 0 or (array.size == 1 and array.dtype.kind in "USO"):
        out.notes.append(f"not used: {group}{name}, a single value")
    else:
        out.add_array(name, array, unit, group=group)


def _read_matlab(out: Contents, content: bytes) -> None:
    if array_file.is_hdf5(content):
        _read_hdf5(out, content)
    else:
        _add_named(out, "", array_file.read_matlab(content))


def _read_hdf5(out: Contents, content: bytes) -> None:
    """Add data sets, and attributes that are facts."""
    values = array_file.read_hdf5(content)
    for path, value in values.items():
        group, sign, name = path.rpartition("@" if "@" in path else "/")
        if sign != "@" or recognise_fact(name) not in (None, "unit"):
            unit = values.get(f"{path}@unit", values.get(f"{path}@units"))
            _add_named(out, name, value, group=group + sign, unit=unit)


def _read_fits(out: Contents, content: bytes) -> None:
    from astropy.io import fits

    with array_file.open_fits(content, uint=False) as units:  # gaps of shifted integers become NaN
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


def _read_text(out: Contents, content: bytes) -> None:
    """Add the columns of a text table, NaN where a cell is no number, and facts in its comments."""
    lines = [line.strip("\r\n ") for line in content.decode("utf-8-sig").splitlines()]
    rows = [(n, line) for n, line in enumerate(lines, start=1) if line and line[0] != "#"]
    comments = [(n, line.lstrip("# ")) for n, line in enumerate(lines, start=1) if line[:1] == "#"]
    for _, comment in comments:  # such as frame_rate_hz = 1000
        sign = min((at for at in map(comment.find, ":=") if at > 0), default=0)
        key, value = comment[:sign].strip(), comment[sign + 1 :].strip()
        fact = recognise_fact(key) if value else None
        if fact == "unit" and " " in value:
            out.notes.append(f"the comment {key} was not taken for a unit: {value!r}")
        elif fact is not None:
            out.add_fact(fact, value, f"the comment {key}")
    if not rows:
        raise TelemetryError("it has no rows.")
    delimiter = next((sign for sign in _DELIMITERS if sign in rows[0][1]), None)
    table = [[cell.strip(' "') for cell in line.split(delimiter)] for _, line in rows]
    above = next((c.split(delimiter) for n, c in comments[::-1] if n < rows[0][0]), [])
    names = [""] * len(table[0])
    if _is_heading(table[0]):
        names = table.pop(0)
        del rows[0]
    elif len(above) == len(names) and _is_heading(above):  # the last comment before the table
        names = above
    if not rows:
        raise TelemetryError("it has a heading and no rows.")
    for (n, _), cells in zip(rows, table, strict=True):
        if len(cells) != len(names):
            raise TelemetryError(f"line {n} must have {len(names)} cells; got {len(cells)}.")
    values = np.array([[_parse_number(cell) for cell in cells] for cells in table])
    for i, (name, of) in enumerate(zip(names, values.T, strict=True)):
        column = parse_column(name, of)
        missing = [(row[i], n) for row, (n, _), x in zip(table, rows, of, strict=True) if x != x]
        wrong = [(cell, n) for cell, n in missing if cell.lower() not in ("", "nan")]
        is_series = column.role in OF_AXES and 2 * len(wrong) > len(table)
        if wrong and (is_series or _DECIMAL_COMMA.fullmatch(wrong[0][0])):
            raise TelemetryError(
                f"{len(wrong)} cells of {join_names([column])} are no numbers, the first "
                f"{wrong[0][0]!r} in line {wrong[0][1]}. Write them with decimal points, and what "
                "is missing as nan."
            )
        out.columns.append(column)


def _is_heading(cells: Sequence[str]) -> bool:
    return any(cells) and all(np.isnan(_parse_number(cell)) for cell in cells)


def _parse_number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


_READERS: dict[str, Callable[[Contents, bytes], None]] = {
    **dict.fromkeys(FITS, _read_fits),
    **dict.fromkeys(
        (".npy", ".npz"), lambda out, content: _add_named(out, "", array_file.read_numpy(content))
    ),
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat"), _read_text),
    **dict.fromkeys((".h5", ".hdf5"), _read_hdf5),
    ".mat": _read_matlab,
    ".sav": lambda out, content: _add_named(out, "", array_file.read_idl(content)),
}


def choose_columns(
    contents: Contents, *, axes: Sequence[int] | None, columns: Mapping[str, Any] | None
) -> Roles:
    """Return the columns of a record by their roles in the order of axes, its series first."""
    chosen = {} if columns is None else columns
    if not isinstance(chosen, Mapping):
        raise ProblemError(
            "columns must be a mapping such as {'measurements': ('a', 'b')}; got "
            f"{type(chosen).__name__}."
        )
    roles: Roles = {}
    for role, wanted in chosen.items():
        choice(role, "a key of columns", tuple(ROLES))
        keys = (wanted,) if isinstance(wanted, str | int) else sequence(wanted, "columns")
        roles[role] = number_axes([c for key in keys for c in _find_columns(contents, key)])
    taken = [id(column.values) for of in roles.values() for column in of]
    if len(set(taken)) < len(taken):
        raise ProblemError("a column was chosen twice in columns.")
    for column in contents.columns:
        if column.role and column.role not in chosen and id(column.values) not in taken:
            roles.setdefault(column.role, []).append(column)
    roles = {role: of for role, of in roles.items() if of}
    series = {role for role in chosen if role in roles and role not in CLOCKS}
    kinds = [kind for kind in _KINDS if series <= {*kind} <= {*roles}]
    if len(kinds) != 1:
        names = [f"{role} ({join_names(of)})" for role, of in roles.items()]
        names += [join_names([column]) for column in contents.columns if column.role is None]
        raise ProblemError(
            f"a record has the columns of {', or '.join(map(' and '.join, _KINDS))}; got "
            f"{'; '.join(names + contents.notes) or 'none'}. Choose by columns={{'measurements': "
            "..., 'commands': ...}, by names or numbers from 0; the measurements of an open loop "
            "by columns={'open_loop': ...}."
        )
    clocks = [role for role in CLOCKS if role in roles and kinds[0] != _KINDS[-1]]
    roles = {role: _in_order(roles[role], role, axes) for role in [*kinds[0], *clocks]}
    contents.notes += [f"{role.replace('_', ' ')}: {join_names(of)}" for role, of in roles.items()]
    used = {id(column.values) for of in roles.values() for column in of}
    if unused := [column for column in contents.columns if id(column.values) not in used]:
        contents.notes.append(f"not used: {join_names(unused)}")
    return roles


def _find_columns(contents: Contents, wanted: Any) -> list[Column]:
    """Return the column of a name or a number, or all columns of an array."""
    columns = contents.columns
    if isinstance(wanted, str):
        name = wanted.strip().lower()
        same = [column for column in columns if column.name.strip().lower() == name]
        same = same or [column for column in columns if column.name.lower().startswith(f"{name}[")]
    else:
        place = integer(wanted, "a number of columns", at_least=0)
        same = columns[place : place + 1]
    if not same:
        raise ProblemError(
            f"there is no column {wanted!r}; the file has {len(columns)}, from 0: "
            f"{join_names(columns)}."
        )
    return same


def _in_order(columns: list[Column], role: str, axes: Sequence[int] | None) -> list[Column]:
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
    if axes is None and count > 2:
        raise ProblemError(
            f"there are {count} {what}; say which are tip and tilt: axes=(0, 1) for the first two."
        )
    given = range(count) if axes is None else sequence(axes, "axes")
    chosen = [integer(axis, "axes", at_least=0) for axis in given]
    if not 1 <= len(chosen) <= 2 or len(set(chosen)) < len(chosen) or max(chosen) >= count:
        raise ProblemError(
            f"axes must be one or two different numbers below {count}, the number of {what}; got "
            f"{chosen}."
        )
    return chosen


def number_axes(columns: Sequence[Column]) -> list[Column]:
    """Return columns numbered as axes, in their order."""
    return [replace(column, axis=axis) for axis, column in enumerate(columns)]


def join_names(columns: Sequence[Column]) -> str:
    """Return the names of columns in one text, of many columns of an array the first and last."""
    names = list[str]()
    for array, run in groupby(columns, lambda column: "".join(_ARRAY.findall(column.name))):
        some = [column.name or "a column without a name" for column in run]
        names += [f"{some[0]} to {some[-1]}"] if array and len(some) > 2 else some
    return ", ".join(names)
