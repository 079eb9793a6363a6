"""The page of a league: the table, each record, and how the numbers were made."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lbt_synth.identification import LoopRecord
from lbt_synth.report import provenance
from lbt_synth.report.charts.description import Axis, Bars, Chart, Panel
from lbt_synth.report.number_text import print_text
from lbt_synth.report.page.blocks import Block, Notice, Page, Paragraph, Section
from lbt_synth.report.page.page_files import require_page_names, write_page
from lbt_synth.report.page.source_section import source_section
from lbt_synth.report.page.words import chart, paragraph
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import column, nm_column, percent_column, row_table, table_row
from lbt_synth.storage.words import count_text
from lbt_synth.studies import LeagueResult, RecordScores, StandingRow
from lbt_synth.studies.league.standings import relative_residual, root_with_error

_LONGEST = 3.0  # bars are cut at so many times the least


@table_row
class RecordRow:
    """A record of a league."""

    record: str = column("record")
    duration_s: float = column("length", unit="s", format=".1f")
    frame_rate_hz: float = column("frame rate", unit="Hz", format="g")
    usable: float = percent_column("usable", format=".1f")
    best: str = column("least residual")
    residual_nm: float = nm_column("it leaves", format=".2f")
    residual_error_nm: float = nm_column("+-", format=".2f")


@table_row
class PlaceRow:
    """An entry on one record."""

    entry: str = column("entry")
    residual_nm: float = nm_column("residual", format=".2f")
    residual_error_nm: float = nm_column("+-", format=".2f")
    above_best: float = percent_column("above the best")
    above_best_error: float = percent_column("+-")
    wins: int = column("wins")


def write_league_page(
    found: LeagueResult,
    records: Mapping[str, LoopRecord],
    path: str | os.PathLike[str],
    *,
    sources: Sequence[str | os.PathLike[str]] = (),
    pdf: str | os.PathLike[str] | None = None,
) -> tuple[Path, ...]:
    """Write the page of a league as one HTML file that opens offline, and as a PDF if wanted.

    Parameters
    ----------
    found : LeagueResult
        The league.
    records : mapping of str to LoopRecord
        Its records, by their names.
    path : path-like
        File to write, that ends in .html.
    sources : sequence of path-like, optional
        Files of the records, whose digests the page gives.
    pdf : path-like, optional
        File to write, that ends in .pdf.

    Returns
    -------
    tuple of pathlib.Path
        The files; all of them are written, or none.

    Raises
    ------
    OutputError
        If a name ends in something else, or a file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=500)
    >>> path, truth = lbt.LoopHardware(frame_rate_hz=500), lbt.Truth(turbulence=slow, noise_nm=5.0)
    >>> ran = lbt.integrator(path, gain=0.3)
    >>> run = lbt.simulate(ran.controller, truth, hardware=path, frames=8000)
    >>> night = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     found = lbt.studies.run_league({"night": night}, folder, entries=["ran"], splits=1)
    ...     files = lbt.report.write_league_page(found, {"night": night}, f"{folder}/league.html")
    >>> files[0].name
    'league.html'
    """
    require_page_names(path, pdf, inputs=tuple(sources))
    return write_page(league_page(found, records, sources), path, pdf)


def league_page(
    found: LeagueResult,
    records: Mapping[str, LoopRecord],
    sources: Sequence[str | os.PathLike[str]] = (),
) -> Page:
    """Return the page of a league."""
    splits = len(found.records[0].splits)
    ran = sum(row.records > 0 for row in found.standings)
    sections = (
        _table_section(found),
        _records_section(found, records),
        Section(
            key="reading",
            title="How to read the standings",
            blocks=tuple(Paragraph(text=paragraph(name)) for name in ("league", "league-errors")),
        ),
        source_section(
            [provenance.read_source(path, "record")[0] for path in sources],
            versions=provenance.program_versions(("pyrtcao",)),
        ),
    )
    return Page(
        title="League of controllers",
        subtitle=(
            f"{count_text(ran, 'entry', 'entries')} on {count_text(len(found.records), 'record')}, "
            f"{count_text(splits, 'split')} each. Made "
            f"{provenance.time_text(provenance.creation_time())}."
        ),
        sections=sections,
    )


def _table_section(found: LeagueResult) -> Section:
    """Open with what is missing, the verdict and the table."""
    blocks: list[Block] = [
        Notice(text=f"{name} is not in the table: {why}", tone="bad")
        for name, why in found.failures.items()
    ]
    blocks += [
        Paragraph(text=print_text(verdict_text(found.standings))),
        row_table("Standings", found.standings, without=("records", "note")),
        *(Notice(text=text) for text in standing_notes(found)),
        _residual_chart(found.standings),
    ]
    return Section(key="standings", title="Standings", blocks=tuple(blocks))


def standing_notes(found: LeagueResult) -> list[str]:
    """Say which entries did not run, or not on all records, and why."""
    notes = []
    for row in found.standings:
        if row.records < len(found.records):
            where = "" if not row.records else f"on {row.records} of {len(found.records)} records: "
            notes.append(f"{row.entry}: {where}{row.note}")
    return notes


def verdict_text(rows: Sequence[StandingRow]) -> str:
    """Say which entry leads, and which of the others are as good within their errors."""
    ranked = [row for row in rows if row.records]
    first, *others = ranked
    text = f"First: {first.entry}."
    if not others:
        return text
    near = [row for row in others if row.above_best <= 2 * row.above_best_error]
    second = others[0]
    text += (
        f" Second: {second.entry}, {100 * second.above_best:.2f} +- "
        f"{100 * second.above_best_error:.2f} % above the best of each record."
    )
    if near:
        names = ", ".join(row.entry for row in near)
        text += f" Within two standard errors of the best: {names}."
    return text


def _residual_chart(rows: Sequence[StandingRow]) -> Chart:
    ranked = [row for row in rows if row.records]
    values = np.array([row.residual_nm for row in ranked])
    errors = np.array([row.residual_error_nm for row in ranked])
    bars = Bars(
        name="", values=values, low=np.maximum(values - 2 * errors, 0), high=values + 2 * errors
    )
    most, least = np.nanmax(values + 2 * errors), np.nanmin(values)
    panel = Panel(
        x=Axis(
            label="residual without noise",
            unit="nm rms",
            low=0,
            high=float(min(1.05 * most, _LONGEST * least)),
        ),
        y=Axis(label=""),
        marks=(bars,),
        categories=tuple(row.entry for row in ranked),
    )
    listing = "; ".join(f"{row.entry} {nm_text(row.residual_nm, '.1f')}" for row in ranked)
    return chart("league", [panel], listing=listing)


def _records_section(found: LeagueResult, records: Mapping[str, LoopRecord]) -> Section:
    titles = {row.name: row.entry for row in found.standings}
    blocks: list[Block] = [
        row_table(
            "Records",
            [_record_row(scores, records[scores.name], titles) for scores in found.records],
        )
    ]
    for scores in found.records:
        rows = [_place_row(scores, name, titles[name]) for name in scores.total.names]
        blocks.append(row_table(scores.name, rows))
        blocks += [Notice(text=f"{titles[name]}: {why}") for name, why in scores.failures.items()]
    return Section(key="records", title="The records", blocks=tuple(blocks))


def _record_row(scores: RecordScores, record: LoopRecord, titles: Mapping[str, str]) -> RecordRow:
    best = scores.total.best
    residual_nm, error_nm = root_with_error(
        scores.total.residual_nm2(best), scores.total.error_nm2(best)
    )
    return RecordRow(
        record=scores.name,
        duration_s=record.duration_s,
        frame_rate_hz=record.frame_rate_hz,
        usable=float(np.mean(record.usable)),
        best=titles[best],
        residual_nm=residual_nm,
        residual_error_nm=error_nm,
    )


def _place_row(scores: RecordScores, name: str, title: str) -> PlaceRow:
    residual_nm, error_nm = root_with_error(
        scores.total.residual_nm2(name), scores.total.error_nm2(name)
    )
    above, above_error = relative_residual(scores.total, name)
    return PlaceRow(
        entry=title,
        residual_nm=residual_nm,
        residual_error_nm=error_nm,
        above_best=above,
        above_best_error=above_error,
        wins=sum(split.best == name for split in scores.splits),
    )
