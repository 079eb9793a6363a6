"""Tables II and III of the paper, computed by modal analysis."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import field, replace

import numpy as np

from lbt_synth.design import Design, FilterDesign, hinf, integrator, kalman, optimal_integrator
from lbt_synth.loop import close_loop
from lbt_synth.storage.rows import column, table_row
from lbt_synth.studies.grid import loop_columns
from lbt_synth.studies.paper import parameters as given
from lbt_synth.studies.paper.parameters import TABLE_II, TABLE_III, VIBRATION_HZ
from lbt_synth.studies.robustness import RobustnessRow, robustness
from lbt_synth.validation import set_fields


@table_row
class TableEntry:
    """One entry of ``table``, "II" or "III", ours beside the paper's."""

    table: str = field()
    label: str = column(key="row", help="Its row")
    method: str = column(help='"classical", or the method of the filter')
    ours: float = column(key="strehl_percent", help="Strehl ratio [%]")
    paper: float = column(key="paper_strehl_percent", help="Strehl ratio [%]")
    difference: float = column(
        key="difference_points", help="Ours less the paper's [points]", init=False
    )

    def __post_init__(self) -> None:
        set_fields(self, difference=self.ours - self.paper)


def rms_difference(entries: list[TableEntry]) -> float:
    """Root mean square of the differences [points]."""
    return float(np.sqrt(np.mean([entry.difference**2 for entry in entries])))


def paper_filters() -> tuple[FilterDesign, FilterDesign]:
    """Kalman and H-infinity filter at the true frequency, with the weights of Table III."""
    return (
        kalman(given.kalman_plant()),
        hinf(given.hinf_plant(), gamma=given.HINF_GAMMA * given.NOISE_NM),
    )


def table_ii() -> list[TableEntry]:
    """Table II: three controllers without and with the vibration."""
    filters = paper_filters()
    hardware = given.kalman_plant().hardware
    entries = []
    for row in TABLE_II:
        lines = given.PAPER_TRUTH.vibrations if row.vibration else ()
        truth = replace(given.PAPER_TRUTH, vibrations=lines)
        classical: Design
        if row.vibration:  # the paper raised the gain for this case
            gain = given.CLASSICAL_EFFECTIVE_GAIN / given.TRUTH_SENSOR_GAIN
            classical = integrator(hardware, gain=gain)
        else:
            classical = optimal_integrator(hardware, truth)
        named = {"classical": classical, **{design.method: design for design in filters}}
        for method, design in named.items():
            loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
            ours = 100 * loop_columns(loop, truth, given.imaging())["strehl"]
            paper = getattr(row, method)
            entry = TableEntry(table="II", label=row.label, method=method, ours=ours, paper=paper)
            entries.append(entry)
    return entries


def table_iii() -> Iterator[RobustnessRow]:
    """Yield the rows of Table III, two per frequency: Kalman, then H-infinity."""
    for row in TABLE_III:
        for method, (plant, bound) in given.filter_problems().items():
            yield from robustness(
                plant,
                given.PAPER_TRUTH,
                given.imaging(),
                errors_hz=[VIBRATION_HZ - row.model_hz],
                methods=[method],
                gamma=bound.get("gamma"),
            )


def compare_with_paper(rows: list[RobustnessRow]) -> list[TableEntry]:
    """Put rows of :func:`table_iii` beside the paper's."""
    published = {row.error_hz: row for row in TABLE_III}
    return [
        TableEntry(
            table="III",
            label=published[row.error_hz].label,
            method=row.method,
            ours=100 * row.strehl,
            paper=getattr(published[row.error_hz], row.method),
        )
        for row in rows
    ]
