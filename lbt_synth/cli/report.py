"""The command report: designs side by side, on a page."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

from lbt_synth.cli.loop_inputs import load_designs, load_shown, named_difference_notes
from lbt_synth.cli.output import Report
from lbt_synth.errors import ProblemError
from lbt_synth.report import design_page, design_report, write_page
from lbt_synth.report.designs.report import (
    WORDS,
    DesignAssessment,
    DesignReport,
    design_facts,
    good_range,
    verdict,
)
from lbt_synth.report.page.html import require_page_names
from lbt_synth.storage.rows import json_record, json_units, row_table

# what JSON has as a key, among the margins, or as numbers in place of words
_WITHOUT = ("design", "modulus", "phase_deg", "delay_frames", "crossover_hz", "scatter", *WORDS)


def run(arguments: Namespace) -> Report:
    """Assess designs in the loop of a configuration, and write the page."""
    inputs = (arguments.config, *arguments.gains)
    require_page_names(arguments.output, arguments.pdf, inputs=inputs)
    if arguments.title is not None and not arguments.title.strip():
        raise ProblemError("--title must hold at least one letter; got an empty text.")
    config = load_shown(arguments)
    designs = load_designs(arguments.gains, any_sensors=True)
    files = dict(zip(designs, arguments.gains, strict=True))
    found = design_report(config, designs, gain_files=files)
    page = design_page(found, title=arguments.title)
    written = write_page(page, arguments.output, pdf=arguments.pdf)
    rows = [design_facts(found, one) for one in found.assessments]
    report = Report(
        data={
            "designs": {
                row.design: json_record(row, without=_WITHOUT) | _design_record(found, one)
                for row, one in zip(rows, found.assessments, strict=True)
            },
            "units": json_units(rows[0]),
            "verdict": verdict(found),
            "limit_nm": None if found.limits.limit is None else found.limits.limit.rms_nm,
            "sensor_gain": found.real_gain,
            "sha256": page.digests,
            "made": page.made,
        },
        tables=[row_table(f"Designs in the loop of {config.source.name}", rows)],
        notes=[
            verdict(found).replace("\u00a0", " "),
            *named_difference_notes(config, designs),
        ],
    )
    report.note_files(written)
    return report


def _design_record(report: DesignReport, one: DesignAssessment) -> dict[str, Any]:
    """Return what JSON says of a design beside its row."""
    return {
        "checks": [json_record(check) for check in one.checks],
        "good_errors_hz": good_range(report, one),
        "margins": None if one.margins is None else json_record(one.margins),
        "stable_sensor_gains": one.sensor_gains,
    }
