"""The page of designs of several sensors: what they leave, what failures do, and the proofs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.loop.simulation.failing_sensors import Drop
from lbt_synth.models.sensor_suite import OWN_SENSOR
from lbt_synth.report.charts.description import Chart
from lbt_synth.report.figures.simulation import sensor_failure_panels
from lbt_synth.report.page.blocks import Block, Notice, Page, Paragraph, Section
from lbt_synth.report.page.page_files import require_page_names, write_page
from lbt_synth.report.page.source_section import source_section
from lbt_synth.report.page.words import chart
from lbt_synth.report.provenance import (
    creation_time,
    read_source,
    time_text,
)
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import fact_table, row_table
from lbt_synth.storage.words import listing_text
from lbt_synth.studies import compare_in_truth
from lbt_synth.studies.limits import TruthComparison
from lbt_synth.studies.robustness import run_failures

_AWAY_S = 1.0  # that each sensor is missing, and that all are there again


def write_sensors_report(
    config: Config,
    designs: Mapping[str, Design],
    path: str | os.PathLike[str],
    *,
    gain_files: Mapping[str, str | os.PathLike[str]] = MappingProxyType({}),
    pdf: str | os.PathLike[str] | None = None,
    title: str | None = None,
) -> tuple[tuple[Path, ...], TruthComparison]:
    """Write the page of designs of several sensors, and as a PDF if that is wanted.

    The truth of the configuration must be stationary. The page gives the digests of the files that
    designs came from.
    """
    require_page_names(path, pdf)
    source, content = read_source(config.source, "configuration")
    text = content.decode("utf-8-sig", errors="replace")
    gains = [read_source(file, f"gain file of {name}")[0] for name, file in gain_files.items()]
    files = [source, *gains]
    found = compare_in_truth(designs, config)
    sections = [_summary_section(config, designs, found)]
    for number, (name, design) in enumerate(designs.items(), start=1):
        failures = design.tables()[0]
        blocks: tuple[Block, ...] = (
            fact_table(name, design.facts()),
            row_table(failures.title, failures.rows),
            _failure_chart(config, name, design, f"failures-{number}"),
            row_table("Certificate, computed again", design.recertify().checks),
        )
        sections.append(Section(key=f"design-{number}", title=name, blocks=blocks))
    sections.append(source_section(files, texts={source.name: text}))
    page = Page(
        title=title or f"Several sensors for {config.source.name}",
        subtitle=f"{listing_text(list(designs))}. Made {time_text(creation_time())}.",
        sections=tuple(sections),
    )
    return write_page(page, path, pdf), found


def _summary_section(
    config: Config, designs: Mapping[str, Design], found: TruthComparison
) -> Section:
    """Open with what each design leaves in the truth, beside references."""
    blocks: list[Block] = []
    for name, design in designs.items():
        own = next(row for row in found.rows if row.design == name)
        others = listing_text(list(design.other_sensors))
        text = f"{name} reads {others} beside the loop's own sensor, and leaves "
        text += nm_text(own.residual_nm, ".1f", unit="nm rms")
        if found.limit is not None:
            least = nm_text(found.limit.rms_nm, ".1f", unit="nm rms")
            text += f"; no controller of the own sensor alone leaves less than {least}"
        blocks.append(Paragraph(text=f"{text}."))
    caption = f"In the truth of {config.source.name}; {config.imaging.label}"
    hidden = ("worst_nm", "above_band_limit_percent", "phase_margin_deg")
    blocks.append(row_table(caption, found.rows, without=hidden))
    blocks += [Notice(text=note) for note in found.notes]
    return Section(key="summary", title="Summary", blocks=tuple(blocks))


def _failure_chart(config: Config, name: str, design: Design, key: str) -> Chart:
    """Draw a run in which each sensor and channel is missing in turn."""
    units = (OWN_SENSOR, *design.other_sensors)
    drops = [
        Drop(unit=unit, start_s=(2 * i + 1) * _AWAY_S, end_s=(2 * i + 2) * _AWAY_S)
        for i, unit in enumerate(units)
    ]
    seconds = (2 * len(units) + 1) * _AWAY_S
    frames, seed = int(seconds * config.hardware.frame_rate_hz), config.settings.simulation.seed
    simulation, rows = run_failures(
        design, config, config.truth, drops, frames=frames, cases=1, seed=seed
    )
    left = [
        f"without {segment.text} {nm_text(row.exact_nm, '.1f', unit='nm rms')}"
        for segment, row in rows
        if segment.text
    ]
    exact_nm = [row.exact_nm for _, row in rows]
    return chart(
        key,
        sensor_failure_panels(simulation, [segment for segment, _ in rows], exact_nm),
        words="sensor-failures",
        name=name,
        away=f"{_AWAY_S:g}",
        residuals=listing_text(left),
    )
