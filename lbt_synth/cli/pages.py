"""The commands report and explore: designs side by side on a page, and a page of sliders."""

from __future__ import annotations

import re
import sys
from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.loop_inputs import load_designs, load_shown, named_difference_notes
from lbt_synth.cli.output import Report
from lbt_synth.errors import ProblemError
from lbt_synth.report import design_page, design_report, write_page
from lbt_synth.report.designs.report import WORDS, design_facts, good_range, verdict
from lbt_synth.report.explore.exploration import explore, new_view
from lbt_synth.report.page.html import require_page_names
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.rows import json_record, json_units, row_table
from lbt_synth.validation import integer

# what JSON has as a key, among the margins, or as numbers in place of words
_WITHOUT = ("design", "modulus", "phase_deg", "delay_frames", "crossover_hz", "scatter", *WORDS)
_LOCAL = ("localhost", "127.0.0.1", "::1")


def run_report(arguments: Namespace) -> Report:
    """Assess designs in the loop of a configuration, and write the page."""
    inputs = (arguments.config, *arguments.gains)
    require_page_names(arguments.output, arguments.pdf, inputs=inputs)
    if arguments.title is not None and not arguments.title.strip():
        raise ProblemError("--title must hold at least one letter; got an empty text.")
    config = load_shown(arguments)
    designs = load_designs(arguments.gains, config)
    files = dict(zip(designs, arguments.gains, strict=True))
    assessed = design_report(config, designs, gain_files=files)
    page = design_page(assessed, title=arguments.title)
    written = write_page(page, arguments.output, pdf=arguments.pdf)
    rows = [design_facts(assessed, one) for one in assessed.assessments]
    limit = assessed.limits.limit
    report = Report(
        data={
            "designs": {
                row.design: json_record(row, without=_WITHOUT)
                | {
                    "checks": [json_record(check) for check in one.checks],
                    "good_errors_hz": good_range(assessed, one),
                    "margins": None if one.margins is None else json_record(one.margins),
                    "stable_sensor_gains": one.sensor_gains,
                }
                for row, one in zip(rows, assessed.assessments, strict=True)
            },
            "units": json_units(rows[0]),
            "limit_nm": None if limit is None else limit.rms_nm,
            "sensor_gain": assessed.real_gain,
            "sha256": page.digests,
            "made": page.made,
        },
        verdict=[verdict(assessed)],
        tables=[row_table(f"Designs in the loop of {config.source.name}", rows)],
        notes=named_difference_notes(config, designs),
    )
    report.note_files(written)
    return report


def run_explore(arguments: Namespace) -> Report:
    """Serve the page until it is interrupted."""
    integer(arguments.port, "--port", at_least=0, at_most=65_535)
    for origin in arguments.origin:
        if not re.fullmatch(r"[\w.*-]+:\d{1,5}", origin):
            raise ProblemError(f"--origin must be HOST:PORT, as localhost:8080; got {origin!r}.")
    folder = Path(arguments.output)
    require_writable(folder / "explored-1.yaml")
    config = load_shown(arguments)
    exploration = explore(config, load_designs(arguments.gains))
    first = new_view(exploration)

    from lbt_synth.report.explore.server import serve  # bokeh's server, slow to import

    served = []

    def announce(url: str) -> None:
        stream = sys.stderr if arguments.json else sys.stdout
        print(f"Open {url} in a browser. Ctrl-C ends.", file=stream, flush=True)
        if arguments.host not in _LOCAL:
            print(
                "note: whoever reaches this address can use the page and write new files into "
                f"{folder}.",
                file=stream,
                flush=True,
            )
        served.append(url)

    saved = serve(
        exploration,
        first,
        folder,
        host=arguments.host,
        port=arguments.port,
        origins=arguments.origin,
        announce=announce,
    )
    report = Report(data={"url": served[0]})
    report.note_files(saved)
    return report
