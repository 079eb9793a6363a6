"""Tables of a diagnosis, the same for a terminal and for a page."""

from __future__ import annotations

from lbt_synth.identification import Diagnosis
from lbt_synth.identification.diagnosis.channels import AXES
from lbt_synth.identification.diagnosis.command_doubt import command_row
from lbt_synth.identification.diagnosis.running_loop import law_row
from lbt_synth.identification.records.faults import HEADINGS
from lbt_synth.identification.records.record import NOT_KNOWN
from lbt_synth.storage.rows import cell_text, fact_table, row_table
from lbt_synth.storage.tables import Table


def diagnosis_tables(found: Diagnosis) -> tuple[Table, ...]:
    """Return the tables of a diagnosis, without those of which nothing is known."""
    tables = [*record_tables(found), *loop_tables(found), *line_tables(found)]
    return (*tables, *residual_tables(found))


def record_tables(found: Diagnosis) -> list[Table]:
    """Return the tables of the record: channels, and frames that are lost."""
    record, health = found.record, found.record.health
    text = f"{record.duration_s:.4g} s at {record.frame_rate_hz:.6g} Hz"
    if health.jitter_frames is not None:
        text += f", clock jitter {health.jitter_frames:.2g} frames rms"
    tables = [row_table(f"Record: {text}. {health.summary()}", found.channels)]
    rows = [
        (kind, series, "-" if axis is None else AXES[axis], *rest)
        for kind, series, axis, *rest in health.rows()
        if kind != NOT_KNOWN  # a consequence of other faults, and of the beginning
    ]
    if rows:
        cells = tuple(tuple(map(cell_text, row)) for row in rows)
        tables.append(Table(caption="Faults", headings=HEADINGS, rows=cells, words=(1, 2, 6)))
    return tables


def loop_tables(found: Diagnosis) -> list[Table]:
    """Return the tables of the loop that ran."""
    tables = []
    if found.commands is not None:
        caption = "How the commands reach the measurements"
        tables.append(row_table(caption, [command_row(found.commands)]))
    if found.law is not None:
        tables.append(row_table("Control law in use, from y to u", [law_row(found.law)]))
    if found.loop is not None:
        tables.append(row_table("Loop", [found.loop]))
    return tables


def line_tables(found: Diagnosis) -> list[Table]:
    """Return the table of vibrations."""
    rows = [line.row for line in found.lines]
    return [row_table("Vibrations, and where they come from", rows)] if rows else []


def residual_tables(found: Diagnosis) -> list[Table]:
    """Return the tables of costs, of residuals on unseen data, and of a given design."""
    tables = []
    if found.costs:
        caption = "What each part leaves by the model of the whole record"
        if found.best:
            caption += f" (best design: {found.best})"
        tables.append(row_table(caption, found.costs))
    if found.residuals:
        caption = (
            "Residual on the second half of the record, by models of the first; "
            f"{found.imaging.label}"
        )
        tables.append(row_table(caption, found.residuals))
    if found.given is not None:
        tables.append(fact_table("The gain file on this record", found.given))
    return tables
