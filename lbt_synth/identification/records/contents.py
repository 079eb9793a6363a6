"""What a file of series holds: columns and facts of FITS, NPY, NPZ and text tables.

The columns of a file that make a record, by their names or as they were chosen.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
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
_SUFFIXES = {  # of numbers that are texts
    "frame_rate_hz": ("hz",),
    "delay_frames": ("frames", "frame"),
    "diameter_m": ("m",),
}
_GAPS = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
_DELIMITERS = (";", "\t", ",", "|")  # else blanks
_DELAY_CARD = "DELAY"
_IN_FRAMES = ("[frame]", "[frames]")  # the unit of a card, where the FITS standard has it
# The roles that give the series of each kind of record, and what is needed beside it.
_SERIES = {
    "closed_loop": ("measurements",),
    "open_loop": ("open_loop",),
    "spectrum": ("density", "amplitude"),
}
_BESIDE = {"closed_loop": "commands", "spectrum": "frequency"}
KINDS = tuple(_SERIES)
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
                out.add_array(name, unit.data, str(unit.header.get("BUNIT", "")) or None)


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
        for field_name in array.dtype.names:
            out.add_array(field_name, array[field_name])
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
        if line.startswith("#"):
            comment = line.lstrip("#").strip()
            above = above if rows else comment
            _add_comment(out, comment)
        elif line:
            rows.append((number, line))
    if not rows:
        raise TelemetryError("it has no rows.")
    sign = next((sign for sign in _DELIMITERS if sign in rows[0][1]), None)
    names = _split_heading(rows[0][1], sign)
    sample = "".join(line for _, line in rows[1:20])
    if sign in (";", "\t") and "," in sample and "." not in sample:
        out.notes.append("commas were taken for decimal points")
        rows = [(number, line.replace(",", ".")) for number, line in rows]
    if None in map(_parse_number, _split_heading(rows[0][1], sign)):
        rows = rows[1:]
    else:
        cells = _split_heading(above, sign)
        named = len(cells) == len(names) and all(
            cell and _parse_number(cell) is None for cell in cells
        )
        names = cells if named else [""] * len(names)
    if not rows:
        raise TelemetryError("it has a heading and no rows.")
    _add_table_of_text(out, rows, names, sign)


def _add_table_of_text(
    out: Contents, rows: list[tuple[int, str]], names: list[str], sign: str | None
) -> None:
    """Add the columns of rows of a text; leave out those of texts that no role needs."""
    lines, columns = [line for _, line in rows], [parse_column(name, np.empty(0)) for name in names]
    with suppress(ValueError):  # the quick way, which knows no gaps
        numbers = np.loadtxt(lines, delimiter=sign, comments=None, ndmin=2, dtype=np.float64)
        if numbers.shape == (len(rows), len(names)):
            pairs = zip(columns, numbers.T, strict=True)
            out.columns += [replace(column, values=values) for column, values in pairs]
            return
    table = (
        [line.split() for line in lines] if sign is None else [*csv.reader(lines, delimiter=sign)]
    )
    for (number, _), cells in zip(rows, table, strict=True):
        if len(cells) != len(names):
            raise TelemetryError(f"line {number} must have {len(names)} cells; got {len(cells)}.")
    for at, (column, cells) in enumerate(zip(columns, zip(*table, strict=True), strict=True)):
        values = [_parse_number(cell) for cell in cells]
        if None not in values:
            out.columns.append(replace(column, values=np.array(values, dtype=np.float64)))
        elif column.name and column.role is None:  # as a remark or a date
            out.left_out.append(f"{column.name} holds texts")
        else:
            bad = values.index(None)
            raise TelemetryError(
                f"cell {at + 1} of line {rows[bad][0]} must be a number; got "
                f"{cells[bad].strip()!r}."
            )
    if not out.columns:
        raise TelemetryError(f"each cell of a column must be a number; got {lines[0]!r}.")


def _add_comment(out: Contents, comment: str) -> None:
    """Add the fact of a comment such as frame_rate_hz = 1000."""
    sign = min((at for at in map(comment.find, ":=") if at > 0), default=0)
    key, value = comment[:sign].strip(), comment[sign + 1 :].strip()
    if value and (fact := recognise_fact(key)) is not None:
        if fact == "unit" and " " in value:
            out.notes.append(f"the comment {key} was not taken for a unit: {value!r}")
        else:
            out.add_fact(fact, value, f"the comment {key}")


def _split_heading(line: str, sign: str | None) -> list[str]:
    cells = line.split() if sign is None else next(csv.reader([line], delimiter=sign), [])
    return [cell.strip().strip('"') for cell in cells]


def _parse_number(cell: str) -> float | None:
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
    there, notes = contents.columns, contents.notes
    notes += [f"{why}; it was left out" for why in contents.left_out]
    if not there:
        raise ProblemError(f"the file holds no series of numbers{_left_out(contents)}.")
    roles = _assign_roles(there, columns) or _assign_by_kind(there, kind, notes)
    kind = _find_kind(roles, contents) if kind is None else kind
    if kind == "open_loop" and "open_loop" not in roles and "measurements" in roles:
        roles["open_loop"] = own = roles["measurements"]
        if len({each.axis for each in own} - {None}) < len(own) and _are_two_axes(own):
            roles["open_loop"] = number_axes(own)
    role = _series_role(roles, kind)
    if role is None:
        needed = [role for role in (_SERIES[kind][0], _BESIDE.get(kind)) if role is not None]
        raise ProblemError(
            f"a record of kind {kind} needs columns of {' and '.join(needed)}"
            + _how_to_choose(contents, *needed)
        )
    clocks = () if kind == "spectrum" else CLOCKS
    chosen = {
        each: _choose_axes(roles[each], each, axes)
        for each in (role, _BESIDE.get(kind), *clocks)
        if each in roles
    }
    notes += [f"{each.replace('_', ' ')}: {join_names(own)}" for each, own in chosen.items()]
    used = {id(column.values) for own in chosen.values() for column in own}
    if unused := [column for column in there if id(column.values) not in used]:
        notes.append(f"not used: {join_names(unused)}")
    if kind == "open_loop" and "commands" in roles:
        notes.append("commands were left out: the record is of an open loop")
    return kind, chosen


def number_axes(columns: Sequence[Column]) -> list[Column]:
    """Return columns numbered as axes, in their order."""
    return [replace(column, axis=axis) for axis, column in enumerate(columns)]


def _series_role(found: Roles, kind: str) -> str | None:
    """Return the role that gives the series of a record, None where something is missing."""
    role = next((role for role in _SERIES[kind] if role in found), None)
    return role if _BESIDE.get(kind, role) in found else None


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
        each = (wanted,) if isinstance(wanted, str | int) else sequence(wanted, "columns")
        out[role] = number_axes([hit for one in each for hit in _find_columns(columns, one)])
    taken = [id(column.values) for own in out.values() for column in own]
    if len(set(taken)) < len(taken):
        raise ProblemError("a column was chosen twice in columns.")
    fixed = set(chosen)
    if fixed & {"density", "amplitude"}:
        fixed |= {"density", "amplitude"}
    for column in columns:
        if column.role is not None and column.role not in fixed and id(column.values) not in taken:
            out.setdefault(column.role, []).append(column)
    return {role: own for role, own in out.items() if own}


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


def _assign_by_kind(columns: Sequence[Column], kind: str | None, notes: list[str]) -> Roles:
    """Return the roles of columns that only the kind of the record tells."""
    if kind == "spectrum" and len(columns) > 1:
        notes.append("the first column was taken for the frequencies, the others for densities")
        return {"frequency": [columns[0]], "density": number_axes(columns[1:])}
    if kind == "open_loop" and (len(columns) == 1 or _are_two_axes(columns)):
        return {"open_loop": number_axes(columns)}
    return {}


def _are_two_axes(columns: Sequence[Column]) -> bool:
    """Return whether two columns are the series of two axes: none rises all the time as a clock."""
    return len(columns) == 2 and not any(np.all(np.diff(column.values) > 0) for column in columns)


def _find_kind(found: Roles, contents: Contents) -> str:
    """Return the kind of record that the names tell."""
    kinds = [kind for kind in KINDS if _series_role(found, kind) is not None]
    if len(kinds) == 1:
        return kinds[0]
    if kinds:
        raise ProblemError(f"the file holds more than one record; say kind: {' or '.join(kinds)}.")
    if "measurements" in found:
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


def _choose_axes(found: list[Column], role: str, axes: Sequence[int] | None) -> list[Column]:
    """Return the columns of the axes, in the order that their names tell."""
    of_axes = role in OF_AXES
    named_axes = {column.axis for column in found if column.axis is not None and of_axes}
    if len(found) > 1 and len(named_axes) < len(found):
        raise ProblemError(
            f"{join_names(found)} are all named as {role}"
            f"{', and not each of an axis of its own' if of_axes else ''}; choose by "
            f"columns={{'{role}': ...}}."
        )
    if not of_axes:
        return found
    ordered = sorted(found, key=lambda column: column.axis or 0)
    return [ordered[i] for i in choose_axes(axes, "axes", len(found), f"columns of {role}")]


def choose_axes(given: Any, name: str, count: int, what: str) -> list[int]:
    """Return the numbers of one or two axes among some series: those given, or all."""
    if given is None:
        if count > 2:
            raise ProblemError(
                f"there are {count} {what}; say which are tip and tilt: {name}=(0, 1) for the "
                "first two."
            )
        return list(range(count))
    axes = [integer(axis, name, at_least=0) for axis in sequence(given, name)]
    if not 1 <= len(axes) <= 2 or len(set(axes)) < len(axes) or max(axes) >= count:
        raise ProblemError(
            f"{name} must be one or two different numbers below {count}, the number of {what}; "
            f"got {list(given)}."
        )
    return axes


def join_names(columns: Sequence[Column]) -> str:
    """Return the names of columns in one text."""
    return ", ".join(column.name or "a column without a name" for column in columns)


def _left_out(contents: Contents) -> str:
    """Return which arrays were left out, and why, to go on in a sentence."""
    return f" ({'; '.join(contents.left_out)})" if contents.left_out else ""


def _how_to_choose(contents: Contents, *roles: str) -> str:
    wanted = ", ".join(f"'{role}': ..." for role in roles)
    return (
        f"; got {join_names(contents.columns)}{_left_out(contents)}. Choose by "
        f"columns={{{wanted}}}, names or numbers from 0."
    )
