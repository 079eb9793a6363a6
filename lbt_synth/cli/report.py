"""The command report: designs side by side, on a page."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import Any

from lbt_synth.cli.loop_inputs import load_designs, load_shown, named_difference_notes
from lbt_synth.cli.output import Report
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.report import design_page, design_report, write_page
from lbt_synth.report.designs.page import sensors_page
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
    several = [name for name, design in designs.items() if design.other_sensors]
    files = dict(zip(designs, arguments.gains, strict=True))
    if several:
        return _report_sensors(arguments, config, designs, several, files)
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
            *(f"note: {one.name}: {note}" for one in found.assessments for note in one.notes),
        ],
    )
    report.note_files(written)
    return report


def _report_sensors(
    arguments: Namespace,
    config: Config,
    designs: Mapping[str, Design],
    several: Sequence[str],
    files: Mapping[str, str],
) -> Report:
    """Write the page of designs of several sensors, which have no one transfer function."""
    if len(several) < len(designs):
        alone = ", ".join(name for name in designs if name not in several)
        raise ProblemError(
            f"a page is of designs of several sensors, or of the loop's own sensor alone; got "
            f"{', '.join(several)} of the first kind and {alone} of the second. lbt-synth limits "
            "takes both."
        )
    page, found = sensors_page(config, designs, gain_files=files, title=arguments.title)
    written = write_page(page, arguments.output, pdf=arguments.pdf)
    report = Report()
    caption = f"Designs in the loop of {config.source.name}; {config.imaging.label}"
    report.add_rows("rows", caption, found.rows, hidden=("worst_nm", "above_band_limit_percent"))
    report.notes += named_difference_notes(config, designs)
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
