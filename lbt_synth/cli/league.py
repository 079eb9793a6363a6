"""The command league: rivals trained on the past of records and scored on what followed."""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lbt_synth import studies
from lbt_synth.cli import loop_records
from lbt_synth.cli.command_repairs import judge_record
from lbt_synth.cli.display import choose_unit
from lbt_synth.cli.engine import choose_engine, keep_finished, require_counts
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import count_progress, show_spinner
from lbt_synth.errors import ProblemError
from lbt_synth.identification import LoopRecord
from lbt_synth.report import write_league_page
from lbt_synth.report.league.page import standing_notes, verdict_text
from lbt_synth.storage.atomic_files import make_directory, refuse_replacing, write_atomically
from lbt_synth.storage.rows import csv_rows
from lbt_synth.storage.words import count_text
from lbt_synth.studies.league.entries import choose_entries

_TABLE, _SCORES, _PAGE, _PRINT = "standings.csv", "scores.csv", "league.html", "league.pdf"
_ODD = re.compile(r"[^A-Za-z0-9_.+-]+")


def run(arguments: Namespace) -> Report:
    """Run a league of all records; write its tables and its page."""
    require_counts(arguments, "jobs", "splits")
    able = [entry for entry in choose_entries(arguments.entries).values() if not entry.missing]
    folder = Path(arguments.output)
    paths = [folder / name for name in (_TABLE, _SCORES, _PAGE)]
    pdf = folder / _PRINT if arguments.pdf else None
    refuse_replacing([*paths, *([pdf] if pdf else [])], arguments.files)
    with show_spinner("reading", quiet=arguments.json):
        records, options, notes = _read_records(arguments)
    diameters = {record.diameter_m for record in records.values()}
    choose_unit(arguments, diameters.pop() if len(diameters) == 1 else None)
    make_directory(folder)
    total = len(records) * arguments.splits * len(able)
    with (
        choose_engine(arguments) as (executor, _),
        count_progress(total=total, what="entries on splits", quiet=arguments.json) as count,
        keep_finished(folder),
    ):
        found = studies.run_league(
            records,
            folder,
            entries=arguments.entries,
            splits=arguments.splits,
            jobs=arguments.jobs,
            executor=executor,
            progress=count,
            options=options,
        )
    files = [
        write_atomically(paths[0], csv_rows(found.standings)),
        write_atomically(paths[1], csv_rows(found.scores)),
        *write_league_page(found, records, paths[2], sources=arguments.files, pdf=pdf),
    ]
    report = _make_report(found, files, able=len(able))
    report.notes = [*notes, *report.notes]
    return report


def _make_report(found: studies.LeagueResult, files: Sequence[Path], *, able: int) -> Report:
    report = Report(data={"records": [scores.name for scores in found.records]})
    splits = len(found.records[0].splits)
    entries = count_text(able, "entry", "entries")
    caption = f"League: {entries}, {count_text(splits, 'split')} of each record"
    report.add_rows("standings", caption, found.standings, hidden=("note",))
    report.data["failures"] = dict(found.failures)
    report.notes += [
        f"warning: {name} is not in the table: {why}" for name, why in found.failures.items()
    ]
    report.notes += [f"note: {text}" for text in standing_notes(found)]
    report.notes.append(verdict_text(found.standings))
    report.note_files(files)
    return report


def _read_records(
    arguments: Namespace,
) -> tuple[dict[str, LoopRecord], dict[str, dict[str, Any]], list[str]]:
    """Return the records and the options of their identification by name, and notes on them."""
    if arguments.commands is not None and len(arguments.files) > 1:
        raise ProblemError(
            f"--commands goes with one record; got {len(arguments.files)}. Join each record and "
            "its commands in one file."
        )
    records: dict[str, LoopRecord] = {}
    options: dict[str, dict[str, Any]] = {}
    notes: list[str] = []
    for path in arguments.files:
        own = Namespace(**(vars(arguments) | {"file": path}))
        try:
            record = _read_series(own)
            settings = loop_records.identification_options(own, record)
            judged = judge_record(own, record)
        except ProblemError as error:
            text = str(error)
            raise ProblemError(text if str(path) in text else f"{path}: {text}") from error
        name = _name_record(path, records)
        records[name], options[name] = record, settings
        notes += [loop_records.marked_note(f"{note} ({name})") for note in judged]
    return records, options, notes


def _read_series(arguments: Namespace) -> LoopRecord:
    """Return a record of series with a known delay."""
    record = loop_records.require_series(loop_records.read_record(arguments), "a league scores")
    _ = record.hardware
    return record


def _name_record(path: str, taken: dict[str, LoopRecord]) -> str:
    """Return the stem of a file as a name that no other record has."""
    stem = _ODD.sub("-", Path(path).stem).lstrip("_.+-") or "record"
    names = [stem, *(f"{stem}-{i}" for i in range(2, len(taken) + 2))]
    return next(name for name in names if name not in taken)
