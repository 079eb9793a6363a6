"""The page of a diagnosis, and the files that it becomes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from lbt_synth.identification import Diagnosis, diagnosis_verdict
from lbt_synth.identification.diagnosis.verdict import NARROW
from lbt_synth.report import provenance
from lbt_synth.report.diagnosis.charts import residual_charts, spectrum_charts
from lbt_synth.report.diagnosis.tables import (
    line_tables,
    loop_tables,
    record_tables,
    residual_tables,
)
from lbt_synth.report.number_text import print_text
from lbt_synth.report.page.blocks import Block, Notice, Page, Paragraph, Section
from lbt_synth.report.page.page_files import require_page_names, write_page
from lbt_synth.report.page.source_section import source_section
from lbt_synth.report.page.words import paragraph
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text


def write_diagnosis(
    found: Diagnosis,
    path: str | os.PathLike[str],
    *,
    pdf: str | os.PathLike[str] | None = None,
    files: Sequence[str | os.PathLike[str]] = (),
) -> tuple[Path, ...]:
    """Write a diagnosis as one HTML file that opens offline, and as a PDF if that is wanted.

    Parameters
    ----------
    found : Diagnosis
        Result of :func:`lbt_synth.identification.diagnose`.
    path : path-like
        File to write, that ends in .html.
    pdf : path-like, optional
        File to write, that ends in .pdf.
    files : sequence of path-like, optional
        Files of the record and of the given design, whose digests the page gives.

    Returns
    -------
    tuple of pathlib.Path
        The files; all of them are written, or none.

    Raises
    ------
    OutputError
        If a name ends in something else, or a file cannot be written.
    FileError
        If one of ``files`` cannot be read.

    Examples
    --------
    >>> import numpy as np, lbt_synth as lbt, pathlib, tempfile
    >>> y = np.random.default_rng(0).standard_normal((3000, 1))
    >>> record = lbt.identification.loop_record(y, frame_rate_hz=500, unit="nm")
    >>> found = lbt.identification.diagnose(record)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [f.name for f in lbt.report.write_diagnosis(found, pathlib.Path(folder) / "d.html")]
    ['d.html']
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
