"""What a screen shows first: sentences that say the point, and one table with what they name."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import integrator
from lbt_synth.errors import LbtSynthError
from lbt_synth.loop.least_residual import ResidualLimit
from lbt_synth.models import Truth
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts
from lbt_synth.storage.tables import Table, least_width
from lbt_synth.storage.words import rank_names, unstable_text
from lbt_synth.studies.limits import limits

if TYPE_CHECKING:  # slow to import
    from lbt_synth.studies.robustness import RobustnessMap

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


def say_residual(name: str, row: Facts, limit: ResidualLimit | None) -> str:
    """Return the sentence on what a stable design leaves in the truth."""
    said = f"{name} leaves {nm_text(row.residual_nm, '.1f')} rms in the truth (Strehl ratio "
    said += f"{100 * row.strehl:.1f} %)"
    if limit is None or np.isnan(row.above_limit_percent):
        return f"{said}."
    least = nm_text(limit.rms_nm, ".1f")
    return f"{said}, {row.above_limit_percent:z.0f} % above the {least} of the best linear one."


def say_limit(limit: ResidualLimit, config: Config) -> str:
    """Return the sentence on the limit of a truth."""
    least = nm_text(limit.rms_nm, ".6g", unit="nm rms")
    own = " of the loop's own sensor" * bool(config.hardware.suite.sensors)
    return f"least residual of any linear controller{own} in the truth: {least}"


def say_maps(maps: Mapping[str, RobustnessMap], real: int, where: str) -> list[str]:
    """Return where designs are unstable, and which keeps the highest Strehl ratio at worst."""
    counts = {name: np.count_nonzero(~grid.stable) for name, grid in maps.items()}
    unstable = sorted((name for name in maps if counts[name]), key=lambda name: -counts[name])
    verdict = []
    if unstable:
        most = f"{'up to ' * (len(unstable) > 1)}{counts[unstable[0]]}"
        pairs = f"{maps[unstable[0]].stable.size} pairs of a sensor gain and a delay error"
        verdict = [f"{unstable_text(unstable)} at {most} of {pairs} of a map."]
    lowest = {name: float(np.min(grid.strehl[:, real])) for name, grid in maps.items()}
    best = max(lowest, key=lambda name: np.nan_to_num(lowest[name]))  # nan is unstable
    if lowest[best] > 0:
        percent = f"{100 * lowest[best]:.1f} %"
        verdict.append(f"{best} keeps the highest Strehl ratio at worst over {where}, {percent}.")
    return verdict


def say_runs(rows: Sequence[Facts]) -> list[str]:
    """Say what the designs of runs leave; of more than two the least and the most first."""
    row_of, verdict = {row.design: row for row in rows}, []
    residuals_nm = {name: float(row.residual_simulated_nm) for name, row in row_of.items()}
    for name, word in rank_names(residuals_nm, " the least,", " the most,").items():
        row = row_of[name]
        said = f"{name} leaves{word} {nm_text(row.residual_simulated_nm, '.1f')} rms (Strehl ratio "
        said += f"{100 * row.strehl_simulated:.1f} %)"
        if row.residual_exact_nm is not None:
            said += f", and {nm_text(row.residual_exact_nm, '.1f')} without chance"
        verdict.append(f"{said}.")
    return verdict


def say_references(truth: Truth, config: Config) -> list[str]:
    """Say what the best controllers of the loop's own sensor leave, if there are any."""
    alone = config.hardware.own_sensor_alone()
    try:
        study = limits({"": integrator(alone, truth=truth)}, alone, truth, config.imaging)
    except LbtSynthError:
        return []
    said = f"The best integrator leaves {nm_text(study.rows[0].residual_nm, '.1f')}"
    if study.limit is not None:
        said += f", the best linear controller {nm_text(study.limit.rms_nm, '.1f')}"
    if config.hardware.suite.sensors:
        said += ", both by the loop's own sensor alone"
    return [f"{said}."]
