"""The page of a diagnosis, its charts and its tables."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from lbt_synth.design import Design
from lbt_synth.identification import Diagnosis
from lbt_synth.identification.diagnosis.diagnosis import NARROW, diagnosis_verdict
from lbt_synth.identification.diagnosis.running_loop import AXES, command_row, law_row
from lbt_synth.identification.records.faults import HEADINGS
from lbt_synth.identification.records.record import NOT_KNOWN
from lbt_synth.linear import Controller
from lbt_synth.report import provenance
from lbt_synth.report.charts.description import Axis, Bars, Chart, Curve, Mark, Panel
from lbt_synth.report.figures.identification import identification_panels
from lbt_synth.report.number_text import number_text, print_text
from lbt_synth.report.page.blocks import Block, Notice, Page, Paragraph, Section
from lbt_synth.report.page.page_files import require_page_names, write_page
from lbt_synth.report.page.source_section import source_section
from lbt_synth.report.page.words import chart, paragraph
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import cell_text, fact_table, row_table
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text, listing_text

_POINTS = 400  # bands of a curve on a page, each with its least and its largest value
_RESIDUAL = Axis(label="residual", unit="nm rms", low=0)
_ROW_IN = 0.42  # height of a category
_SIGMAS = 2.0


def residual_charts(found: Diagnosis) -> list[Chart]:
    """Return bars of the residuals on unseen data, and of the parts of the disturbance."""
    charts = []
    if rows := found.residuals:
        values = np.array([row.replayed_nm for row in rows])
        errors = _SIGMAS * np.array([row.replayed_error_nm for row in rows])
        bars: tuple[Bars, ...] = (
            Bars(name="data", values=values, low=values - errors, high=values + errors),
            Bars(name="model", values=np.array([row.model_nm for row in rows]), look=1),
        )
        names = [row.name for row in rows]
        shown = np.where(np.isfinite(values), values, [row.model_nm for row in rows])
        pairs = zip(names, shown.tolist(), strict=True)  # the limit has no data
        said = [f"{name} {nm_text(value_nm, '.1f')}" for name, value_nm in pairs]
        charts.append(chart("residuals", [_bar_panel(bars, names)], values=listing_text(said)))
    if costs := found.costs:
        columns = {"loop that ran": "running_nm", "best design": "best_nm"}
        bars = tuple(
            Bars(name=name, values=np.array([getattr(row, field) for row in costs]), look=look)
            for look, (name, field) in enumerate(columns.items())
        )
        said = [
            f"{row.part} {nm_text(row.running_nm, '.1f')} and {nm_text(row.best_nm, '.1f')}"
            for row in costs
        ]
        panel = _bar_panel(bars, [row.part for row in costs])
        best = found.best or "none"
        charts.append(chart("costs", [panel], values=listing_text(said), best=best))
    return charts


def _bar_panel(bars: tuple[Bars, ...], names: list[str]) -> Panel:
    return Panel(
        x=_RESIDUAL,
        y=Axis(label=""),
        marks=bars,
        categories=tuple(names),
        height_in=_ROW_IN * max(len(names), 2),
    )


def spectrum_charts(found: Diagnosis) -> list[Chart]:
    """Return the chart of the identified model."""
    model = found.model
    if model is None:
        return []
    designs: Mapping[str, Controller | Design] = {}
    if found.best_design is not None:
        designs = {found.best: found.best_design}
    panels = [
        replace(panel, marks=tuple(map(_thin_curve, panel.marks)))
        for panel in identification_panels(model, designs)
    ]
    lines = [f"{number_text(line.row.frequency_hz)} Hz" for line in found.lines]
    words = listing_text(lines) or "none"
    return [chart("identification", panels, columns=len(model.axes), lines=words)]


def _thin_curve(mark: Mark) -> Mark:
    """Return a curve of many points with the least and the largest value of each band."""
    if not isinstance(mark, Curve) or mark.x.size <= 4 * _POINTS:
        return mark
    edges = np.searchsorted(mark.x, np.geomspace(mark.x[0], mark.x[-1], _POINTS))
    kept = {0, mark.x.size - 1}
    for start, stop in pairwise(edges.tolist()):
        if stop > start:
            band = mark.y[start:stop]
            kept |= {start + int(np.argmin(band)), start + int(np.argmax(band))}
    where = np.array(sorted(kept))
    return replace(mark, x=mark.x[where], y=mark.y[where])


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


def write_diagnosis(
    found: Diagnosis,
    path: str | os.PathLike[str],
    *,
    pdf: str | os.PathLike[str] | None = None,
    files: Sequence[str | os.PathLike[str]] = (),
) -> tuple[Path, ...]:
    """Write a diagnosis as one HTML file that opens offline, and as a PDF if that is wanted.

    ``files`` are those of the record and of the given design, whose digests the page gives. All
    files are written, or none; a wrong ending or a file that cannot be written raises an
    OutputError.
    """
    require_page_names(path, pdf, inputs=tuple(files))
    return write_page(diagnosis_page(found, files), path, pdf)


def diagnosis_page(found: Diagnosis, files: Sequence[str | os.PathLike[str]] = ()) -> Page:
    """Return the page of a diagnosis."""
    roles = ("record", "gain file")
    read = [
        provenance.read_source(Path(file), role)[0]
        for file, role in zip(files, roles, strict=False)
    ]
    name = read[0].name if read else found.record.source or "a record"
    record = found.record
    sections = [
        Section(key="verdict", title="Verdict", blocks=tuple(_verdict_blocks(found))),
        Section(key="record", title="Record", blocks=tuple(_print_tables(record_tables(found)))),
        Section(
            key="loop",
            title="Loop that ran",
            blocks=(Paragraph(text=paragraph("law")), *_print_tables(loop_tables(found))),
        ),
        Section(
            key="disturbance",
            title="Disturbance",
            blocks=(*_print_tables(line_tables(found)), *spectrum_charts(found))
            or (Paragraph(text="No model was identified."),),
        ),
        source_section(read),
    ]
    return Page(
        title=f"Diagnosis of {name}",
        subtitle=f"{record.duration_s:.4g} s at {record.frame_rate_hz:.6g} Hz, "
        f"{count_text(record.axes, 'axis', 'axes')}. Made "
        f"{provenance.time_text(provenance.creation_time())}.",
        sections=tuple(section for section in sections if section.blocks),
    )


def _print_tables(tables: Iterable[Table]) -> list[Table]:
    """Return tables with the signs of print in their words, too."""
    return [
        replace(
            table,
            rows=tuple(
                tuple(print_text(cell) if isinstance(cell, str) else cell for cell in row)
                for row in table.rows
            ),
        )
        for table in tables
    ]


def _verdict_blocks(found: Diagnosis) -> list[Block]:
    state, *rest = diagnosis_verdict(found)
    wrong = found.doubt or any(row.serious for row in found.channels)
    doubtful = found.loop is None or found.loop.modulus < NARROW
    tone = "bad" if wrong else "note" if doubtful else "good"
    return [
        Notice(text=print_text(state), tone=tone),
        Paragraph(text=print_text(" ".join(rest))),
        *_print_tables(residual_tables(found)),
        *residual_charts(found),
        *(Notice(text=print_text(f"{note[0].upper()}{note[1:]}")) for note in found.notes),
    ]
