"""The columns of a file that make a record, by their names or as they were chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.columns import OF_AXES, ROLES, Column
from lbt_synth.identification.records.contents import Contents
from lbt_synth.validation import choice, integer, sequence

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """Columns that make a record."""

    kind: str  # one of KINDS
    role: str  # of its measurements or densities
    columns: Roles  # those of a role with axes in the order of the axes, of another role one


def select_series(
    contents: Contents,
    *,
    kind: str | None,
    axes: Sequence[int] | None,
    columns: Mapping[str, Any] | None,
) -> Series:
    """Choose the columns of a record, and note which."""
    there, notes = contents.columns, contents.notes
    notes += [f"{why}; it was left out" for why in contents.left_out]
    if not there:
        raise ProblemError(f"the file holds no series of numbers{_left_out(contents)}.")
    found = _assign_roles(there, columns) or _assign_by_kind(there, kind, notes)
    kind = _find_kind(found, contents) if kind is None else kind
    if kind == "open_loop" and "open_loop" not in found and "measurements" in found:
        found["open_loop"] = found["measurements"]
    role = _series_role(found, kind)
    if role is None:
        needed = [role for role in (_SERIES[kind][0], _BESIDE.get(kind)) if role is not None]
        raise ProblemError(
            f"a record of kind {kind} needs columns of {' and '.join(needed)}"
            + _how_to_choose(contents, *needed)
        )
    clocks = () if kind == "spectrum" else CLOCKS
    chosen = {
        each: _choose_axes(found[each], each, axes)
        for each in (role, _BESIDE.get(kind), *clocks)
        if each in found
    }
    if kind == "closed_loop":
        _require_same_axes(chosen)
    notes += [f"{each.replace('_', ' ')}: {join_names(own)}" for each, own in chosen.items()]
    used = {id(column.values) for own in chosen.values() for column in own}
    if left := [column for column in there if id(column.values) not in used]:
        notes.append(f"not used: {join_names(left)}")
    if kind == "open_loop" and "commands" in found:
        notes.append("commands were left out: the record is of an open loop")
    return Series(kind=kind, role=role, columns=chosen)


def number_axes(columns: Sequence[Column]) -> list[Column]:
    """Return columns numbered as axes, in their order."""
    return [replace(each, axis=axis) for axis, each in enumerate(columns)]


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
        hits = [each for each in columns if each.name.strip().lower() == name]
        if len(hits) > 1:
            raise ProblemError(f"{len(hits)} columns are named {wanted!r}; choose by numbers.")
        hits = hits or [each for each in columns if each.name.lower().startswith(f"{name}[")]
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
    if kind == "open_loop" and len(columns) == 1:  # of several, one may be a clock
        return {"open_loop": number_axes(columns)}
    return {}


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
    known = {each.axis for each in found if each.axis is not None and of_axes}
    if len(found) > 1 and len(known) < len(found):
        raise ProblemError(
            f"{join_names(found)} are all named as {role}"
            f"{', and not each of an axis of its own' if of_axes else ''}; choose by "
            f"columns={{'{role}': ...}}."
        )
    if not of_axes:
        return found
    ordered = sorted(found, key=lambda each: each.axis or 0)
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


def _require_same_axes(chosen: Roles) -> None:
    """Refuse measurements of one axis with commands of another."""
    y, u = chosen["measurements"], chosen["commands"]
    mine, theirs = ([each.axis for each in own] for own in (y, u))
    from_one = sorted([mine, theirs], key=str) == [[0, 1], [1, 2]]  # one of them counts from 1
    if None not in (*mine, *theirs) and len(y) == len(u) and mine != theirs and not from_one:
        raise ProblemError(
            f"measurements and commands must be of the same axes; got {join_names(y)} with "
            f"{join_names(u)}. Choose by columns={{'measurements': ..., 'commands': ...}} if they "
            "do belong together."
        )


def join_names(columns: Sequence[Column]) -> str:
    """Return the names of columns in one text."""
    return ", ".join(each.name or "a column without a name" for each in columns)


def _left_out(contents: Contents) -> str:
    """Return which arrays were left out, and why, to go on in a sentence."""
    return f" ({'; '.join(contents.left_out)})" if contents.left_out else ""


def _how_to_choose(contents: Contents, *roles: str) -> str:
    wanted = ", ".join(f"'{role}': ..." for role in roles)
    return (
        f"; got {join_names(contents.columns)}{_left_out(contents)}. Choose by "
        f"columns={{{wanted}}}, names or numbers from 0."
    )
