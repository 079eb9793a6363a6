"""The command diagnose: the autopsy of a record."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict
from typing import Any

from lbt_synth.cli import loop_records
from lbt_synth.cli.arguments import given_options
from lbt_synth.cli.loop_inputs import choose_unit, load_designs
from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import count_progress
from lbt_synth.errors import ProblemError
from lbt_synth.identification import Diagnosis, LoopRecord, diagnose
from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.diagnosis import disturbance_lines, live_axes
from lbt_synth.report.diagnosis import diagnosis_page, diagnosis_tables
from lbt_synth.report.page.html import require_page_names, write_page
from lbt_synth.storage.rows import json_record

_STEPS = 3


def run(arguments: Namespace) -> Report:
    """Diagnose a record, with a design to try on it if one is given, and write the page."""
    if arguments.output is not None:
        named = given_options(arguments, "file", "gain", "commands", "lines_file")
        require_page_names(arguments.output, arguments.pdf, inputs=tuple(named.values()))
    elif arguments.pdf is not None:
        raise ProblemError("--pdf is the page of -o on paper; give -o, too.")
    given = {} if arguments.gain is None else load_designs([arguments.gain])
    whole = _load(arguments)
    choose_unit(arguments, whole.diameter_m)
    live = live_axes(whole)
    record = whole if len(live) in (0, whole.axes) else _load(arguments, live)
    with count_progress(total=_STEPS, what="diagnosing") as count:
        found = diagnose(
            record.bridged(),
            given=given,
            whole=whole,
            imaging=loop_records.record_imaging(arguments, record),
            progress=count,
            **loop_records.identification_options(arguments, record),
        )
    report = Report(
        data={"source": str(arguments.file), "verdict": found.verdict, **_diagnosis_data(found)},
        opening=list(found.verdict),
        tables=[table for own in diagnosis_tables(found).values() for table in own],
        notes=[loop_records.marked_note(note) for note in found.notes],
    )
    if arguments.output is not None:
        files = (arguments.file, *([arguments.gain] if arguments.gain else []))
        page = diagnosis_page(found, files)
        report.note_files(write_page(page, arguments.output, pdf=arguments.pdf))
    return report


def _load(arguments: Namespace, axes: list[int] | None = None) -> LoopRecord:
    """Load the record, or some of its axes."""
    return loop_records.require_series(
        loop_records.load_series(arguments, axes), "diagnose examines"
    )


def _diagnosis_data(found: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis for JSON; what could not be said is null or empty."""
    record = found.record
    lines = () if found.model is None else disturbance_lines(found.model)
    return {
        "doubt": found.doubt or None,
        "record": loop_records.record_data(record),
        "channels": [json_record(row) for row in found.channels],
        "commands": None if found.commands is None else json_record(found.commands.facts()),
        "control_law": None if found.law is None else _law_data(found.law),
        "loop": None if found.loop is None else json_record(found.loop),
        "lines": [asdict(line) for line in lines],
        "costs": [json_record(row) for row in found.costs],
        "residuals": [json_record(row) for row in found.residuals],
        "best": found.best or None,
        "notes": found.notes,
    }


def _law_data(law: ControlLaw) -> dict[str, Any]:
    values = asdict(law)
    return values | {"poles": [[abs(pole) for pole in row] for row in law.poles]}
