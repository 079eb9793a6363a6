"""A report of designs as a page, and the files that it becomes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.models import SinusoidalVibration
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.report.designs.charts import (
    pole_and_step_charts,
    robustness_charts,
    simulation_charts,
    transfer_charts,
)
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.designs.tables import certificate_table, summary_table, truth_table, verdict
from lbt_synth.report.number_text import number_text
from lbt_synth.report.page.blocks import Block, Notice, Page, Paragraph, Section
from lbt_synth.report.page.page_files import require_page_names, write_page
from lbt_synth.report.page.source_section import source_section
from lbt_synth.report.page.words import paragraph
from lbt_synth.report.provenance import require_letters, time_text
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.words import count_text, listing_text


def write_report(
    report: DesignReport,
    path: str | os.PathLike[str],
    *,
    pdf: str | os.PathLike[str] | None = None,
    title: str | None = None,
) -> tuple[Path, ...]:
    """Write a report as one HTML file that opens offline, and as a PDF if that is wanted.

    Parameters
    ----------
    report : DesignReport
        Result of :func:`design_report`.
    path : path-like
        File to write, that ends in .html.
    pdf : path-like, optional
        File to write, that ends in .pdf.
    title : str, optional
        Heading of the page; by default it names the configuration.

    Returns
    -------
    tuple of pathlib.Path
        The files; all of them are written, or none.

    Raises
    ------
    OutputError
        If a name ends in something else, or a file cannot be written.
    ProblemError
        If the title is empty, or cannot be shown.

    Examples
    --------
    >>> import lbt_synth as lbt, pathlib, tempfile
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = lbt.design.optimal_integrator(config.hardware, config.truth)
    >>> report = lbt.report.design_report(config, {"integrator": slow})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [file.name for file in lbt.report.write_report(report, pathlib.Path(folder) / "a.html")]
    ['a.html']
    """
    require_page_names(path, pdf)
    return write_page(design_page(report, title=title), path, pdf)


def design_page(report: DesignReport, *, title: str | None = None) -> Page:
    """Return the page of a report."""
    source = report.config.source.name
    heading = f"Controllers for {source}" if title is None else title.strip()
    if not heading:
        raise ProblemError("title must hold at least one letter; got an empty text.")
    require_letters(heading, "title")
    count = len(report.assessments)
    names = listing_text([one.name for one in report.assessments])
    sections = [
        Section(key="summary", title="Summary", blocks=tuple(_summary_blocks(report))),
        Section(key="transfer", title="Transfer functions", blocks=tuple(_transfer_blocks(report))),
        Section(key="errors", title="Robustness", blocks=tuple(robustness_charts(report))),
        Section(key="dynamics", title="Dynamics", blocks=tuple(pole_and_step_charts(report))),
        Section(key="simulation", title="Simulation", blocks=tuple(_simulation_blocks(report))),
        Section(
            key="certificates", title="Certificates", blocks=tuple(_certificate_blocks(report))
        ),
        source_section(report.files, versions=report.versions, texts={source: report.config_text}),
    ]
    return Page(
        title=heading,
        subtitle=f"{count_text(count, 'design')}: {names}. Made {time_text(report.made)}.",
        sections=tuple(sections),
    )


def _summary_blocks(report: DesignReport) -> list[Block]:
    blocks: list[Block] = []
    for one in report.assessments:
        if not one.stable:
            text = paragraph(
                "unstable",
                name=one.name,
                radius=number_text(one.spectral_radius, 6),
                gain=number_text(report.real_gain),
            )
            blocks.append(Notice(text=text, tone="bad"))
        if not one.certified:
            why = one.certificate_error or "; ".join(
                f"{check.name} {number_text(check.value, 6)}, limit {number_text(check.limit, 6)}"
                for check in one.checks
                if not check.passed
            )
            blocks.append(Notice(text=f"The certificate of {one.name} fails: {why}", tone="bad"))
    return [
        *blocks,
        Paragraph(text=verdict(report)),
        summary_table(report),
        truth_table(report),
        *(
            Notice(text=f"{one.name}: {text}.")
            for one in report.stable
            for text in report.truth.warnings[one.name]
        ),
        *(Notice(text=note) for note in report.truth.notes),
        Paragraph(text=_situation_text(report)),
        *(
            Notice(text=f"{one.name} was {note}")
            for one in report.assessments
            for note in one.notes
        ),
    ]


def _situation_text(report: DesignReport) -> str:
    """Return the paragraph about the loop and its disturbances."""
    hardware, truth = report.config.hardware, report.config.truth
    lines = [
        f"a {'sinusoid' if isinstance(line, SinusoidalVibration) else 'resonance'} of "
        f"{nm_text(line.rms_nm, '.6g', unit='nm rms')} at {number_text(line.frequency_hz)} Hz"
        for line in stationary_vibrations(truth.vibrations)
    ]
    noise = truth.noise_per_measurement(hardware.n_measurements)
    return paragraph(
        "situation",
        axes="1 axis" if hardware.modes == 1 else f"{hardware.modes} axes",
        rate=number_text(hardware.frame_rate_hz),
        delay=number_text(hardware.delay_frames),
        mirror="that settles at once" if hardware.mirror is None else "with dynamics",
        turbulence=report.config.settings.true_turbulence.replace("_", " "),
        lines=listing_text(lines) or "no vibration",
        noise=listing_text([nm_text(float(value)) for value in np.unique(noise)]),
        gain=number_text(report.real_gain),
    )


def _transfer_blocks(report: DesignReport) -> list[Block]:
    """Return the charts of transfer functions, and say so if no loop is stable."""
    charts: list[Block] = [*transfer_charts(report)]
    if report.stable:
        return charts
    return [
        Paragraph(text="No loop is stable, so none has a rejection or a noise transfer."),
        *charts,
    ]


def _simulation_blocks(report: DesignReport) -> list[Block]:
    settings = report.config.settings.simulation
    charts = simulation_charts(report)
    if not charts:
        return [Paragraph(text="No loop is stable, so none was simulated.")]
    frames = next(iter(report.simulations.values())).frames
    text = f"{count_text(settings.cases, 'run')} of {frames} frames each, seed {settings.seed}."
    return [Paragraph(text=text), *charts]


def _certificate_blocks(report: DesignReport) -> list[Block]:
    blocks: list[Block] = [Paragraph(text=paragraph("certificates"))]
    for one in report.assessments:
        missing = f"{one.name}: not computed: {one.certificate_error}"
        blocks.append(
            Notice(text=missing, tone="bad") if one.certificate_error else certificate_table(one)
        )
    return blocks
