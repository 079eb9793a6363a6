"""Commands from a second file, matched with the measurements of the first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lbt_synth.errors import TelemetryError
from lbt_synth.identification.records.column_selection import number_axes
from lbt_synth.identification.records.columns import Column
from lbt_synth.identification.records.contents import Contents
from lbt_synth.identification.records.units import seconds_per
from lbt_synth.validation import BoolArray, FloatArray, IntArray

_SAME_TIME = 0.25  # of a step
_LEAST_SHARE = 0.5  # of the measurements, that have a command
_CLOCKS = ("frame_numbers", "times")


def join_commands(contents: Contents, other: Contents, path: Path) -> None:
    """Add the commands of another file, in place of those of the first.

    Rows are matched by the counters of both files, or else by the times of both (within a
    quarter of a step). Without a common clock both files must have equally many rows.
    """
    named = [each for each in other.columns if each.role == "commands"]
    if not named:
        named = [each for each in other.columns if each.role in (None, "measurements")]
    if not named:
        raise TelemetryError(f"{path} holds no commands.", path=path)
    named = _match_commands(contents, other, named, path)
    own = [each for each in contents.columns if each.role != "commands"]
    if not any(each.role in ("measurements", "open_loop") for each in own):
        plain = number_axes([each for each in own if each.role is None])
        own = [each for each in own if each.role is not None]
        own += [replace(each, role="measurements") for each in plain]
    if len(named) > 1 and any(each.axis is None for each in named):
        named = number_axes(named)
    contents.columns = own + [replace(each, role="commands") for each in named]
    for fact, places in other.facts.items():
        if fact == "unit":
            continue
        for where, value in places.items():
            contents.add_fact(fact, value, f"{where} in {path.name}")
    # a unit is that of its own file
    contents.facts["command unit"] = dict(other.facts.get("unit", {}))
    contents.notes += [f"commands are from {path}", *other.notes]


def _match_commands(
    contents: Contents, other: Contents, named: list[Column], path: Path
) -> list[Column]:
    """Return the commands in the rows of the measurements, NaN where there are none."""
    counts = {len(each.values) for each in named}
    rows = {len(each.values) for each in contents.columns}
    for role in _CLOCKS:
        mine, theirs = (
            [each for each in file.columns if each.role == role] for file in (contents, other)
        )
        if len(mine) == len(theirs) == 1:
            if rows | {len(mine[0].values)} != rows or len(rows) > 1 or len(counts) > 1:
                break  # refused below
            if counts != {len(theirs[0].values)}:
                break
            at, there = _match_rows(
                _clock_values(mine[0], role), _clock_values(theirs[0], role), role, path
            )
            if there.all() and len(at) in counts and np.array_equal(at, np.arange(len(at))):
                return named
            spread = []
            for each in named:
                values = np.full(len(at), np.nan)
                values[there] = each.values[at[there]]
                spread.append(replace(each, values=values))
            contents.notes.append(
                f"commands were laid beside the measurements by {theirs[0].name}: "
                f"{int(np.sum(there))} of {len(at)} rows have one"
            )
            return spread
    if len(rows | counts) > 1:
        raise TelemetryError(
            f"{path} must have as many frames as the measurements; got "
            f"{', '.join(map(str, sorted(rows | counts)))}. Or give both files a counter of "
            "frames, or times.",
            path=path,
        )
    if any(each.role in _CLOCKS for each in (*contents.columns, *other.columns)):
        contents.notes.append(
            "the files have no clock in common: rows of the same number were taken for one frame"
        )
    return named


def _clock_values(column: Column, role: str) -> FloatArray:
    return column.values * (seconds_per(column.unit) if role == "times" else 1.0)


def _match_rows(
    mine: FloatArray, theirs: FloatArray, role: str, path: Path
) -> tuple[IntArray, BoolArray]:
    """Return the row of the second clock for each of the first, and whether there is one."""
    for clock in (mine, theirs):
        if not np.all(np.isfinite(clock)) or np.any(np.diff(clock) < 0):
            raise TelemetryError(f"the {role} of both files must rise, without gaps.", path=path)
    if np.array_equal(mine, theirs):
        return np.arange(len(mine)), np.ones(len(mine), dtype=np.bool_)
    if np.any(np.diff(theirs) <= 0):
        raise TelemetryError(
            f"the {role} of {path} must rise from row to row to be matched with those of the "
            "measurements; got two rows alike.",
            path=path,
        )
    near = 0.0
    if role == "times":
        steps = [np.diff(clock) for clock in (mine, theirs)]
        near = _SAME_TIME * min(float(np.median(s[s > 0])) if np.any(s > 0) else 0.0 for s in steps)
    after = np.clip(np.searchsorted(theirs, mine), 0, len(theirs) - 1)
    before = np.maximum(after - 1, 0)
    at = np.where(np.abs(theirs[before] - mine) < np.abs(theirs[after] - mine), before, after)
    there = np.abs(theirs[at] - mine) <= near
    if np.mean(there) < _LEAST_SHARE:
        raise TelemetryError(
            f"only {int(np.sum(there))} of {len(mine)} measurements have a command in {path} by "
            f"their {role}; they go from {mine[0]:.12g} to {mine[-1]:.12g} and from "
            f"{theirs[0]:.12g} to {theirs[-1]:.12g}. Give files of the same frames, or leave the "
            f"{role} away in one of them if the rows do belong together.",
            path=path,
        )
    return np.asarray(at, dtype=np.int64), there
