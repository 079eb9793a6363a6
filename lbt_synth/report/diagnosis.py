"""The page of a diagnosis, its charts and its tables."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lbt_synth.identification.diagnosis import Diagnosis, law_facts
from lbt_synth.identification.fit.identified_model import model_tables
from lbt_synth.identification.records.record import NOT_KNOWN
from lbt_synth.report.draw import draw_bars
from lbt_synth.report.figures import identification_figure
from lbt_synth.report.page.html import Block, Chart, Notice, Page, chart, new_page, paragraph
from lbt_synth.storage.rows import row_table
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text

_SIGMAS = 2.0  # of an interval that holds 95 %
_RESIDUAL = {"label": "residual", "unit": "nm rms", "low": 0}


def _residual_charts(diagnosis: Diagnosis) -> list[Chart]:
    """Return bars of the residuals on unseen data, and of the parts of the disturbance."""
    charts = []
    if rows := diagnosis.residuals:
        values, errors, promised = np.array(
            [(row.replayed_nm, _SIGMAS * row.replayed_error_nm, row.model_nm) for row in rows]
        ).T
        bars, intervals = (
            {"data": values, "model": promised},
            {"data": (values - errors, values + errors)},
        )
        figure = draw_bars(_RESIDUAL, [row.name for row in rows], bars, intervals)
        charts.append(chart("residuals", figure))
    if costs := diagnosis.costs:
        bars = {
            "loop that ran": np.array([row.running_nm for row in costs]),
            "best design": np.array([row.best_nm for row in costs]),
        }
        figure = draw_bars(_RESIDUAL, [row.part for row in costs], bars, {})
        charts.append(chart("costs", figure, best=diagnosis.best or "none"))
    return charts


def _spectrum_charts(diagnosis: Diagnosis) -> list[Chart]:
    """Return the chart of the identified model."""
    if diagnosis.model is None:
        return []
    designs = {} if diagnosis.best_design is None else {diagnosis.best: diagnosis.best_design}
    figure = identification_figure(diagnosis.model, designs=designs)
    return [chart("identification", figure)]


def diagnosis_tables(diagnosis: Diagnosis) -> dict[str, list[Table]]:
    """Return the tables of a diagnosis by their sections, without those of what is not known."""
    record = diagnosis.record
    text = f"{record.duration_s:.4g} s at {record.frame_rate_hz:.6g} Hz"
    channels = [row_table(f"Record: {text}. {record.summary()}", diagnosis.channels)]
    # what a correction lacks is a consequence of other faults, and of the beginning
    if faults := [finding for finding in record.findings if finding.kind != NOT_KNOWN]:
        channels.append(row_table("Faults", faults))
    commands, law = diagnosis.commands, diagnosis.law
    loop = {
        "How the commands reach the measurements": commands and [commands.facts()],
        "Control law in use, from y to u": law and [law_facts(law)],
        "Loop": diagnosis.loop and [diagnosis.loop],
    }
    best = f" (best design: {diagnosis.best})" if diagnosis.best else ""
    unseen = "Residual on the second half of the record, by models of the first"
    residuals = {
        f"What each part leaves by the model of the first half{best}": diagnosis.costs,
        f"{unseen}; {diagnosis.imaging.label}": diagnosis.residuals,
    }
    lines = [] if diagnosis.model is None else model_tables(diagnosis.model)[1:]
    return {
        "record": channels,
        "loop": [row_table(caption, rows) for caption, rows in loop.items() if rows],
        "disturbance": lines,
        "verdict": [row_table(caption, rows) for caption, rows in residuals.items() if rows],
    }


def diagnosis_page(diagnosis: Diagnosis, files: Sequence[str | os.PathLike[str]] = ()) -> Page:
    """Return the page of a diagnosis.

    ``files`` are those of the record and of the given design, whose digests the page gives.
    """
    record, tables = diagnosis.record, diagnosis_tables(diagnosis)
    name = Path(files[0]).name if files else record.source or "a record"
    duration = f"{record.duration_s:.4g} s at {record.frame_rate_hz:.6g} Hz"
    disturbance: list[Block] = [*tables["disturbance"], *_spectrum_charts(diagnosis)]
    return new_page(
        f"Diagnosis of {name}",
        f"{duration}, {count_text(record.axes, 'axis', 'axes')}",
        {
            "Verdict": _verdict_blocks(diagnosis, tables["verdict"]),
            "Record": tables["record"],
            "Loop that ran": (paragraph("law"), *tables["loop"]),
            "Disturbance": disturbance or ["No model was identified."],
        },
        sources=list(zip(files, ("record", "gain file"), strict=False)),
    )


def _verdict_blocks(diagnosis: Diagnosis, tables: Sequence[Table]) -> list[Block]:
    state, *rest = diagnosis.verdict
    return [
        Notice(text=state, tone=diagnosis.findings[0].tone),
        " ".join(rest),
        *tables,
        *_residual_charts(diagnosis),
        *(Notice(text=f"{note[0].upper()}{note[1:]}") for note in diagnosis.notes),
    ]
