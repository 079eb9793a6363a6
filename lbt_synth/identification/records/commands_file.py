"""Commands from a second file, matched with the measurements of the first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lbt_synth.errors import TelemetryError
from lbt_synth.identification.records.column_selection import CLOCKS, number_axes
from lbt_synth.identification.records.columns import Column
from lbt_synth.identification.records.contents import Contents
from lbt_synth.identification.records.units import seconds_per
from lbt_synth.validation import FloatArray, IntArray

_SAME_TIME = 0.25  # of a step
_LEAST_SHARE = 0.5  # of the measurements, that have a command


def join_commands(contents: Contents, other: Contents, path: Path) -> None:
    """Add the commands of another file, in place of those of the first.

    Rows are matched by the counters of both files, or else by the times of both (within a
    quarter of a step). Without a common clock both files must have equally many rows.
    """
    named = [each for each in other.columns if each.role == "commands"] or [
        each for each in other.columns if each.role in (None, "measurements")
    ]
    if not named:
        raise TelemetryError(f"{path} holds no commands.", path=path)
    named = _match_commands(contents, other, named, path)
    if len(named) > 1 and any(each.axis is None for each in named):
        named = number_axes(named)
    own = [each for each in contents.columns if each.role != "commands"]
    if not any(each.role in ("measurements", "open_loop") for each in own):
        plain = number_axes([each for each in own if each.role is None])
        own = [each for each in own if each.role is not None]
        own += [replace(each, role="measurements") for each in plain]
    contents.columns = own + [replace(each, role="commands") for each in named]
    for fact, places in other.facts.items():
        if fact != "unit":
            for where, value in places.items():
                contents.facts.setdefault(fact, {})[f"{where} in {path.name}"] = value
    # a unit is that of its own file
    contents.facts["command_unit"] = dict(other.facts.get("unit", {}))
    contents.notes += [f"commands are from {path}", *other.notes]


def _match_commands(
    contents: Contents, other: Contents, named: list[Column], path: Path
) -> list[Column]:
    """Return the commands in the rows of the measurements, NaN where there are none."""
    rows, counts = ({len(each.values) for each in own} for own in (contents.columns, named))
    for role in CLOCKS:
        mine, theirs = (_find_clock(file, role) for file in (contents, other))
        if mine is None or theirs is None:
            continue
        if rows != {len(mine.values)} or counts != {len(theirs.values)}:
            break  # refused below
        at = _match_rows(_clock_values(mine), _clock_values(theirs), role, path)
        if np.array_equal(at, np.arange(len(theirs.values))):
            return named
        there = at >= 0
        contents.notes.append(
            f"commands were laid beside the measurements by {theirs.name}: {int(np.sum(there))} of "
            f"{len(at)} rows have one"
        )
        return [replace(each, values=np.where(there, each.values[at], np.nan)) for each in named]
    if len(rows | counts) > 1:
        raise TelemetryError(
            f"{path} must have as many frames as the measurements; got "
            f"{', '.join(map(str, sorted(rows | counts)))}. Or give both files a counter of "
            "frames, or times.",
            path=path,
        )
    if any(each.role in CLOCKS for each in (*contents.columns, *other.columns)):
        contents.notes.append(
            "the files have no clock in common: rows of the same number were taken for one frame"
        )
    return named


def _find_clock(file: Contents, role: str) -> Column | None:
    """Return the clock of a file, if it has one and not more."""
    found = [each for each in file.columns if each.role == role]
    return found[0] if len(found) == 1 else None


def _clock_values(clock: Column) -> FloatArray:
    return clock.values * (seconds_per(clock.unit) if clock.role == "times" else 1.0)


def _match_rows(one: FloatArray, other: FloatArray, role: str, path: Path) -> IntArray:
    """Return the row of the second clock for each row of the first, -1 where there is none."""
    if not all(np.all(np.isfinite(each)) and np.all(np.diff(each) >= 0) for each in (one, other)):
        raise TelemetryError(f"the {role} of both files must rise, without gaps.", path=path)
    if np.array_equal(one, other):
        return np.arange(len(one))
    if np.any(np.diff(other) <= 0):
        raise TelemetryError(
            f"the {role} of {path} must rise from row to row to be matched with those of the "
            "measurements; got two rows alike.",
            path=path,
        )
    near = _SAME_TIME * min(map(_median_step, (one, other))) if role == "times" else 0.0
    at = np.searchsorted((other[1:] + other[:-1]) / 2, one, side="right")
    at = np.where(np.abs(other[at] - one) <= near, at, -1)
    if np.mean(at >= 0) < _LEAST_SHARE:
        raise TelemetryError(
            f"only {int(np.sum(at >= 0))} of {len(one)} measurements have a command in {path} by "
            f"their {role}; they go from {one[0]:.12g} to {one[-1]:.12g} and from {other[0]:.12g} "
            f"to {other[-1]:.12g}. Give files of the same frames, or leave the {role} away in one "
            "of them if the rows do belong together.",
            path=path,
        )
    return at


def _median_step(clock: FloatArray) -> float:
    steps = np.diff(clock)
    return float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
