"""A table on a screen: what a verdict names is in it, and long names are shortened."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from lbt_synth.storage.tables import Table, least_width

_SHORTEST_NAME = 8  # letters that a name keeps which is shortened to make room


def brief_table(table: Table, room: int, most: int, verdict: str) -> Table:
    """Return a table that needs one part, with at most so many rows.

    Rows and columns that the verdict names stay, then rows from end to end, and the first columns
    and facts. Gaps are narrowed and long names shortened before a column is left out.
    """
    rows = [row[0].text for row in table.cells()]
    names = [heading.split(" [")[0] for heading in table.headings[1:]]
    shown = _chosen(rows, most, verdict, spread=table.headings[0] != "quantity")
    left_out = [f"{len(shown)} of {len(rows)} rows"] * (len(shown) < len(rows))
    caption, table = table.caption, replace(table, rows=tuple(table.rows[i] for i in shown))
    for count in range(len(names), 0, -1):
        part = table.picked([i + 1 for i in _chosen(names, count, verdict, spread=False)])
        tight = replace(part, gap=part.gap - 1)
        longest = max(map(len, _names(part)), default=0)
        short = (_shortened(tight, letters) for letters in range(longest, _SHORTEST_NAME - 1, -1))
        fits = (one for one in (part, tight, *short) if least_width(one) <= room)
        if (fitting := next(fits, None)) is not None:
            left_out += [f"{count} of {len(names)} columns"] * (count < len(names))
            table = fitting
            break
    if left_out:
        caption += f" ({', '.join(left_out)}; the others with --verbose)"
    return replace(table, caption=caption)


def _chosen(names: Sequence[str], most: int, verdict: str, *, spread: bool) -> list[int]:
    """Return the places of at most so many names: those in a verdict, then from end to end."""
    at = [re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-]|\.\w)", verdict) for name in names]
    said = sorted((match.start(), i) for i, match in enumerate(at) if match and names[i])
    kept = [i for _, i in said][:most]
    others = [i for i in range(len(names)) if i not in kept]
    count = min(most - len(kept), len(others))
    step = (len(others) - 1) / max(count - 1, 1) if spread else 1
    return sorted([*kept, *(others[round(i * step)] for i in range(count))])


def _names(table: Table) -> set[str]:
    """Return the headings and names of rows that are one word, but for a unit."""
    words = (*table.headings, *(row[0].text for row in table.cells()))
    return {name for word in words if " " not in (name := word.split(" [")[0])}


def _shortened(table: Table, letters: int) -> Table:
    """Return a table with the middle of longer names left out, where they stay distinct."""
    names = [name for name in _names(table) if len(name) > letters]
    for end in range((letters - 1) // 2, letters - 1):
        short = {name: f"{name[: letters - 1 - end]}…{name[len(name) - end :]}" for name in names}
        if len({*short.values()}) == len(names):
            break
    else:
        return table

    def said(heading: str) -> str:
        name, *unit = heading.split(" [")
        return " [".join([short.get(name, name), *unit])

    rows = ((replace(row[0], text=said(row[0].text)), *row[1:]) for row in table.cells())
    return replace(table, headings=tuple(map(said, table.headings)), rows=tuple(rows))
