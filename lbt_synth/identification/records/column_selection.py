"""The columns of a file that make a record, by their names or as they were chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.columns import ROLES, Column, rises
from lbt_synth.identification.records.contents import Contents
from lbt_synth.validation import choice, integer, sequence

_SPECTRAL = ("frequency", "density", "amplitude")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """Columns that make a record."""

    kind: str  # "closed_loop", "open_loop" or "spectrum"
    measurements: tuple[Column, ...]  # per axis; of an open loop its series, or densities
    commands: tuple[Column, ...] = ()  # per axis, of a closed loop
    times: Column | None = None
    frame_numbers: Column | None = None
    frequency: Column | None = None
    amplitude: bool = False  # whether the densities are named as those of an amplitude
    notes: tuple[str, ...] = ()  # which columns were taken for what


def select_series(
    contents: Contents,
    *,
    kind: str | None,
    axes: Sequence[int] | None,
    columns: Mapping[str, Any] | None,
) -> Series:
    """Choose the columns of a record."""
    if not contents.columns:
        raise ProblemError("the file holds no series of numbers.")
    notes: list[str] = []
    roles = _assign_roles(contents.columns, columns)
    if not any(roles.values()):
        roles = _assign_by_kind(contents.columns, kind, notes)
    kind = _find_kind(roles, contents.columns) if kind is None else kind
    if kind == "spectrum":
        role = _first_role(roles, "density", "amplitude")
        chosen = {role: _choose_axes(roles[role], role, axes)} if role else {}
        if role is None or not roles["frequency"]:
            raise ProblemError(
                "a spectrum needs columns of frequencies and densities"
                + _how_to_choose(contents.columns, "frequency", "density")
            )
        series = Series(
            kind=kind,
            measurements=chosen[role],
            frequency=_only_column(roles, "frequency"),
            amplitude=role == "amplitude",
        )
    else:
        role = _first_role(roles, "open_loop", "measurements")
        if kind == "closed_loop":
            role = "measurements" if roles["measurements"] else None
        if role is None or (kind == "closed_loop" and not roles["commands"]):
            raise ProblemError(
                f"a record of kind {kind} needs measurements"
                + (" and commands" if kind == "closed_loop" else "")
                + _how_to_choose(contents.columns, "measurements", "commands")
            )
        if kind == "open_loop" and roles["commands"]:
            notes.append("commands were left out: the record is of an open loop")
        series = Series(
            kind=kind,
            measurements=_choose_axes(roles[role], role, axes),
            commands=(
                _choose_axes(roles["commands"], "commands", axes) if kind == "closed_loop" else ()
            ),
            times=_only_column(roles, "times"),
            frame_numbers=_only_column(roles, "frame_numbers"),
        )
        _require_same_axes(series)
    return _add_notes(series, contents.columns, notes)


def _require_same_axes(series: Series) -> None:
    """Refuse measurements of one axis with commands of another."""
    mine, theirs = (
        [each.axis for each in chosen if each.axis is not None]
        for chosen in (series.measurements, series.commands)
    )
    if len(mine) != len(series.measurements) or len(theirs) != len(series.commands):
        return
    from_one = {tuple(mine), tuple(theirs)} == {(0, 1), (1, 2)}  # one counts from 1
    if len(mine) == len(theirs) and mine != theirs and not from_one:
        raise ProblemError(
            f"measurements and commands must be of the same axes; got "
            f"{_join_names(series.measurements)} with {_join_names(series.commands)}. Choose by "
            "columns={'measurements': ..., 'commands': ...} if they do belong together."
        )


def number_axes(columns: Sequence[Column]) -> list[Column]:
    """Return columns numbered as axes, in their order."""
    return [replace(each, axis=axis) for axis, each in enumerate(columns)]


def _assign_roles(
    columns: Sequence[Column], chosen: Mapping[str, Any] | None
) -> dict[str, list[Column]]:
    """Return the columns of each role: those that were chosen, then by names."""
    out: dict[str, list[Column]] = {role: [] for role in ROLES}
    if chosen is not None and not isinstance(chosen, Mapping):
        raise ProblemError(
            "columns must be a mapping such as {'measurements': ('a', 'b')}; got "
            f"{type(chosen).__name__}."
        )
    taken: list[Column] = []
    for role, wanted in (chosen or {}).items():
        choice(role, "a key of columns", tuple(ROLES))
        for one in (wanted,) if isinstance(wanted, str | int) else sequence(wanted, "columns"):
            taken += (found := _find_columns(columns, one))
            out[role] += found
        out[role] = number_axes(out[role])
    used = {id(each.values) for each in taken}
    if len(used) < len(taken):
        raise ProblemError("a column was chosen twice in columns.")
    fixed = set(chosen or {})
    if fixed & {"density", "amplitude"}:
        fixed |= {"density", "amplitude"}
    for each in columns:
        if each.role is not None and each.role not in fixed and id(each.values) not in used:
            out[each.role].append(each)
    return out


def _find_columns(columns: Sequence[Column], wanted: Any) -> list[Column]:
    """Find the columns of a name, all of an array, or of a number."""
    if isinstance(wanted, str):
        hits = [each for each in columns if each.name.strip().lower() == wanted.strip().lower()]
        whole = wanted.strip().lower() + "["
        hits = hits or [each for each in columns if each.name.lower().startswith(whole)]
        if not hits:
            raise ProblemError(f"there is no column {wanted!r}; got {_join_names(columns)}.")
        if len(hits) > 1 and not hits[0].name.endswith("]"):
            raise ProblemError(f"{len(hits)} columns are named {wanted!r}; choose by numbers.")
        return hits
    number = integer(wanted, "a number of columns", at_least=0)
    if number >= len(columns):
        raise ProblemError(f"there is no column {number}; the file has {len(columns)}, from 0.")
    return [columns[number]]


def _assign_by_kind(
    columns: Sequence[Column], kind: str | None, notes: list[str]
) -> dict[str, list[Column]]:
    """Return the roles of columns that only the kind of the record tells."""
    out: dict[str, list[Column]] = {role: [] for role in ROLES}
    if kind is None:
        raise ProblemError(
            "names do not tell what the columns are"
            + _how_to_choose(columns, "measurements", "commands")
            + " Or say what kind the record is."
        )
    if kind == "spectrum" and len(columns) > 1:
        out["frequency"], out["density"] = [columns[0]], number_axes(columns[1:])
        notes.append("the first column was taken for the frequencies, the others for densities")
    elif kind == "open_loop":
        for number, each in enumerate(columns):
            if rises(each.values):
                raise ProblemError(
                    f"column {number} ({_join_names([each])}) rises from row to row, as a clock "
                    f"does: choose by columns={{'times': {number}, 'open_loop': ...}}, by names or "
                    "numbers from 0."
                )
        out["open_loop"] = number_axes(columns)
        notes.append("all columns were taken for the open-loop series")
    return out


def _find_kind(roles: Mapping[str, list[Column]], columns: Sequence[Column]) -> str:
    """Return the kind of record that the names tell."""
    spectrum = bool(roles["frequency"]) and bool(_first_role(roles, "density", "amplitude"))
    found = [
        name
        for name, there in (
            ("spectrum", spectrum),
            ("open_loop", bool(roles["open_loop"])),
            ("closed_loop", bool(roles["measurements"]) and bool(roles["commands"])),
        )
        if there
    ]
    if len(found) > 1:
        raise ProblemError(f"the file holds more than one record; say kind: {' or '.join(found)}.")
    if found:
        return found[0]
    if roles["measurements"]:
        raise ProblemError(
            "the file has measurements and no commands. Residuals of a closed loop need its "
            "commands: give the file that has them, or choose their columns. If the loop was "
            "open, or the series is of the pseudo-open loop, say kind open_loop."
        )
    raise ProblemError(
        "names do not tell what the columns are"
        + _how_to_choose(columns, "measurements", "commands")
    )


def _first_role(roles: Mapping[str, list[Column]], *names: str) -> str | None:
    return next((name for name in names if roles[name]), None)


def _only_column(roles: Mapping[str, list[Column]], role: str) -> Column | None:
    found = roles[role]
    if len(found) > 1:
        raise ProblemError(
            f"{_join_names(found)} are all named as {role}; choose by columns={{'{role}': ...}}."
        )
    return found[0] if found else None


def _choose_axes(
    found: Sequence[Column], role: str, axes: Sequence[int] | None
) -> tuple[Column, ...]:
    """Return the columns of the axes, in the order that their names tell."""
    known = [each.axis for each in found if each.axis is not None]
    if len(found) > 1 and (len(known) < len(found) or len(set(known)) < len(known)):
        raise ProblemError(
            f"{_join_names(found)} are all named as {role}, and not each of an axis of its own; "
            f"choose by columns={{'{role}': ...}}."
        )
    ordered = sorted(found, key=lambda each: each.axis or 0)
    if axes is None:
        if len(ordered) > 2:
            raise ProblemError(
                f"there are {len(ordered)} columns of {role}; say which are tip and tilt: "
                "axes=(0, 1) for the first two."
            )
        return tuple(ordered)
    given = [integer(axis, "axes", at_least=0) for axis in sequence(axes, "axes")]
    if not 1 <= len(given) <= 2 or len(set(given)) < len(given) or max(given) >= len(ordered):
        raise ProblemError(
            f"axes must be one or two different numbers below {len(ordered)}, the columns of "
            f"{role}; got {list(axes)}."
        )
    return tuple(ordered[axis] for axis in given)


def _add_notes(series: Series, columns: Sequence[Column], notes: list[str]) -> Series:
    """Add notes on which columns were taken for what, and which were not used."""
    what = {"closed_loop": "measurements", "open_loop": "the open loop", "spectrum": "densities"}
    parts = [(what[series.kind], series.measurements), ("commands", series.commands)]
    for word, each in (
        ("times", series.times),
        ("frame numbers", series.frame_numbers),
        ("frequencies", series.frequency),
    ):
        parts += [(word, (each,))] if each is not None else []
    said = [f"{word}: {_join_names(chosen)}" for word, chosen in parts if chosen]
    used = {id(each.values) for _, chosen in parts for each in chosen}
    left = [each for each in columns if id(each.values) not in used]
    if left:
        said.append(f"not used: {_join_names(left)}")
    return replace(series, notes=(*said, *notes))


def _join_names(columns: Sequence[Column]) -> str:
    return ", ".join(each.name or "a column without a name" for each in columns)


def _how_to_choose(columns: Sequence[Column], *roles: str) -> str:
    wanted = ", ".join(f"'{role}': ..." for role in roles)
    return (
        f"; got {_join_names(columns)}. Choose by columns={{{wanted}}}, by names or numbers from 0."
    )
