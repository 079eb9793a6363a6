"""Pages of designs: their sections, charts and words, and their files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.loop.simulation.run import Drop
from lbt_synth.models import SinusoidalVibration
from lbt_synth.models.sensor_suite import OWN_SENSOR
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.report.designs.report import DesignAssessment, DesignReport
from lbt_synth.report.designs.simulation import run_spectra
from lbt_synth.report.designs.tables import summary_table, verdict
from lbt_synth.report.draw import (
    Figure,
    count_columns,
    drawing,
    square_in,
)
from lbt_synth.report.figures.loops import (
    FREQUENCY,
    design_steps,
    draw_bode,
    draw_design,
    draw_sigma,
    draw_steps,
    margins_text,
    open_loops,
    sigma_curves,
)
from lbt_synth.report.figures.records import SPECTRUM, TIME, sensor_failure_figure
from lbt_synth.report.figures.studies import (
    FREQUENCY_ERROR,
    draw_limits,
    draw_maps,
    strehl_axis,
    strehl_ends,
)
from lbt_synth.report.page.blocks import (
    Block,
    Chart,
    Notice,
    Page,
    chart,
    creation_time,
    paragraph,
    read_source,
    require_letters,
    source_section,
    survival_blocks,
    time_text,
)
from lbt_synth.report.page.html import require_page_names, write_page
from lbt_synth.storage.display_unit import nm_text, shown_unit
from lbt_synth.storage.rows import fact_table, row_table
from lbt_synth.storage.words import count_text, listing_text
from lbt_synth.studies import compare_in_truth
from lbt_synth.studies.limits import TruthComparison
from lbt_synth.studies.robustness import run_failures

_PANELS = 6  # of one figure that has a panel per design: they fit a sheet
_EXCERPT = 400  # frames of a simulated series


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
    count, names = len(report.assessments), listing_text(report.names)
    sections: dict[str, tuple[str, Sequence[Block]]] = {
        "summary": ("Summary", _summary_blocks(report)),
        "transfer": ("Transfer functions", _transfer_blocks(report)),
        "errors": ("Robustness", _robustness_charts(report)),
        "dynamics": ("Dynamics", _dynamics_charts(report)),
        "simulation": ("Simulation", _simulation_blocks(report)),
        "certificates": ("Certificates", _certificate_blocks(report)),
        **source_section(
            report.files, versions=report.versions, texts={source: report.config_text}
        ),
    }
    return Page(
        title=heading,
        subtitle=f"{count_text(count, 'design')}: {names}. Made {time_text(report.made)}.",
        sections=sections,
    )


def _summary_blocks(report: DesignReport) -> list[Block]:
    blocks: list[Block] = []
    for one in report.assessments:
        if not one.stable:
            text = paragraph(
                "unstable",
                name=one.name,
                radius=f"{one.loop.spectral_radius:.6g}",
                gain=f"{report.real_gain:.4g}",
            )
            blocks.append(Notice(text=text, tone="bad"))
        if not one.certified:
            why = one.certificate_error or "; ".join(
                f"{check.name} {check.value:.6g}, limit {check.limit:.6g}"
                for check in one.checks
                if not check.passed
            )
            blocks.append(Notice(text=f"The certificate of {one.name} fails: {why}", tone="bad"))
    return [
        *blocks,
        verdict(report),
        *survival_blocks({one.name: one.margins for one in report.assessments if one.margins}),
        summary_table(report),
        *_truth_blocks(report.config, report.truth, ("method", "stable")),
        _situation_text(report),
        *(
            Notice(text=f"{one.name} was {note}")
            for one in report.assessments
            for note in one.notes
        ),
    ]


def _truth_blocks(
    config: Config, truth: TruthComparison, without: Sequence[str] = ()
) -> list[Block]:
    """Return the designs beside reference designs, and what is wrong with them in the truth."""
    caption = f"In the truth of {config.source.name}; {config.imaging.label}"
    hidden = ("worst_nm", "above_band_limit_percent", *without)
    stable = {row.design for row in truth.rows if row.stable}
    return [
        row_table(caption, truth.rows, without=hidden),
        *(
            Notice(text=f"{name}: {text}.")
            for name, texts in truth.warnings.items()
            if name in stable  # an unstable loop is named above
            for text in texts
        ),
        *(Notice(text=note) for note in truth.notes),
    ]


def _situation_text(report: DesignReport) -> str:
    """Return the paragraph about the loop and its disturbances."""
    hardware, truth = report.config.hardware, report.config.truth
    lines = [
        f"a {'sinusoid' if isinstance(line, SinusoidalVibration) else 'resonance'} of "
        f"{nm_text(line.rms_nm, '.6g', unit='nm rms')} at {line.frequency_hz:.4g} Hz"
        for line in stationary_vibrations(truth.vibrations)
    ]
    noise = truth.noise_per_measurement(hardware.n_measurements)
    return paragraph(
        "situation",
        axes="1 axis" if hardware.modes == 1 else f"{hardware.modes} axes",
        rate=f"{hardware.frame_rate_hz:.6g}",
        delay=f"{hardware.delay_frames:.4g}",
        mirror="that settles at once" if hardware.mirror is None else "with dynamics",
        turbulence=report.config.settings.true_turbulence.replace("_", " "),
        lines=listing_text(lines) or "no vibration",
        noise=listing_text([nm_text(float(value)) for value in np.unique(noise)]),
        gain=f"{report.real_gain:.4g}",
    )


def _certificate_blocks(report: DesignReport) -> list[Block]:
    blocks: list[Block] = [paragraph("certificates")]
    for one in report.assessments:
        missing = f"{one.name}: not computed: {one.certificate_error}"
        blocks.append(
            Notice(text=missing, tone="bad")
            if one.certificate_error
            else row_table(f"Certificate of {one.name}", one.checks)
        )
    return blocks


def _transfer_blocks(report: DesignReport) -> list[Block]:
    """Return singular values of the estimation error and of the closed loops, and their margins."""
    lines_hz, gain = report.config.truth.lines_hz, f"{report.real_gain:.4g}"
    designs = {one.name: one.design for one in report.assessments}
    loops = {one.name: one.loop for one in report.assessments}
    curves = sigma_curves(designs, loops, lines_hz=lines_hz)
    blocks: list[Block] = []
    if not report.stable:
        loops = {}
        blocks.append("No loop is stable, so none has a rejection or a noise transfer.")
    if loops or any(error is not None for _, error, *_ in curves.values()):
        line = "true vibration" if len(lines_hz) == 1 else "true vibrations"
        figure = draw_sigma(curves, loops, lines_hz, line=line)
        unit, factor = shown_unit("nm")
        largest: dict[str, list[str]] = {"peaks": [], "rejection": [], "noise": []}
        for name, (_, *norms) in curves.items():
            for what, norm in zip(largest, norms, strict=True):
                if norm is not None:
                    scale, of = (factor, f" {unit}") if what == "peaks" else (1.0, "")
                    largest[what].append(f"{name} {scale * np.max(norm):.3g}{of}")
        said = {what: listing_text(texts) or "none" for what, texts in largest.items()}
        blocks.append(chart("sigma", figure, gain=gain, **said))
    if loops:
        opened = open_loops(loops)
        margins = listing_text([f"{name} {margins_text(broken)}" for name, *_, broken in opened])
        blocks.append(chart("bode", draw_bode(loops), gain=gain, margins=margins))
    return blocks


def _robustness_charts(report: DesignReport) -> list[Chart]:
    """Strehl ratio and residual over the frequency error, and maps with the sensor gain."""
    if report.errors_hz.size == 1:
        return [_sensor_gain_chart(report)]
    charts = [_strehl_chart(report), _residual_chart(report)] if report.stable else []
    ends = strehl_ends([one.map for one in report.assessments])
    for number, batch in _sheets(report.assessments):
        maps = {one.name: one.map for one in batch}
        figure = draw_maps(maps, real_gain=report.real_gain, ends=ends)
        charts.append(chart(f"map{number}", figure, ranges=_map_texts(batch)))
    return charts


def _sheets(items: Sequence[Any]) -> Iterator[tuple[str, Sequence[Any]]]:
    """Yield the items of figures that each fit a sheet of paper, and the end of their keys."""
    for start in range(0, len(items), _PANELS):
        number = f"-{start // _PANELS + 1}" if start else ""
        yield number, items[start : start + _PANELS]


def _strehl_chart(report: DesignReport) -> Chart:
    worst = {one.name: one.curve.strehl[0, 0] for one in report.stable}
    ends = [
        f"{name} falls to {100 * np.min(strehl):.1f} % at "
        f"{report.errors_hz[np.argmin(strehl)]:+.4g} Hz"
        for name, strehl in worst.items()
    ]
    with drawing([2.5]) as (panel,):
        values = np.concatenate([100 * strehl for strehl in worst.values()])
        panel.set_axes(FREQUENCY_ERROR, strehl_axis(values))
        for one in report.assessments:
            percents = 100 * one.curve.strehl[0, 0] if one.stable else None
            draw_design(panel, report.names, one.name, one.curve.errors_hz, percents)
    gain = f"{report.real_gain:.4g}"
    return chart("robustness", panel.figure, gain=gain, ends=listing_text(ends))


def _residual_chart(report: DesignReport) -> Chart:
    study = report.limits
    figure = draw_limits(study, report.names, FREQUENCY_ERROR)
    limits = [
        f"{name} {nm_text(limit.rms_nm, '.1f')}"
        for name, limit in (
            ("limit, frequency known", study.limit),
            ("limit, frequency anywhere in this range", study.band),
        )
        if limit is not None and limit.rms_nm > 0
    ]
    worst = [f"{row.design} {nm_text(row.worst_nm, '.1f')}" for row in study.rows if row.stable]
    said = f" Limits: {listing_text(limits)}." if limits else ""
    return chart("limits", figure, worst=listing_text(worst), limits=said)


def _map_texts(assessments: Sequence[DesignAssessment]) -> str:
    """Say of each design how far its Strehl ratio ranges over its map."""
    texts = []
    for one in assessments:
        values = 100 * one.map.strehl[np.isfinite(one.map.strehl)]
        if not values.size:
            texts.append(f"{one.name}: unstable everywhere.")
            continue
        texts.append(
            f"{one.name}: {values.min():.1f} to {values.max():.1f} %, stable at "
            f"{int(one.map.stable.sum())} of {one.map.stable.size} sensor gains."
        )
    return " ".join(texts)


def _sensor_gain_chart(report: DesignReport) -> Chart:
    """Strehl ratio over the sensor gain, drawn for a truth without vibrations."""
    with drawing([2.5]) as (panel,):
        y_axis = {"label": "Strehl ratio", "unit": "%", "low": 0.0}
        panel.set_axes({"label": "sensor gain", "unit": "-"}, y_axis)
        for one in report.assessments:
            percents = 100 * one.map.strehl[0, :, 0]
            draw_design(panel, report.names, one.name, one.map.sensor_gains, percents)
        panel.rule("real sensor gain", report.real_gain, dash=3)
    return chart("sensor-gain", panel.figure, ranges=_map_texts(report.assessments))


def _dynamics_charts(report: DesignReport) -> list[Chart]:
    """Poles, and step responses."""
    poles = [
        (one.loop.system.poles, np.linalg.eigvals(one.design.controller.A))
        for one in report.assessments
    ]
    reach = 1.06 * max(1.0, *(float(np.max(np.abs(values))) for pair in poles for values in pair))
    radii = [f"{one.name} {one.loop.spectral_radius:.6g}" for one in report.assessments]
    charts = [
        chart(f"poles{number}", _draw_poles(batch, reach), radii=listing_text(radii))
        for number, batch in _sheets(list(zip(report.assessments, poles, strict=True)))
    ]
    if not report.stable:
        return charts
    loops = {one.name: one.loop for one in report.stable}
    peaks = [
        f"{name} {100 * np.max(np.abs(step.residual[5:])):.0f} %"
        for name, steps in design_steps(loops).items()
        for step in steps
    ]
    frame = f"{1e3 / report.config.hardware.frame_rate_hz:.4g}"
    return [*charts, chart("step", draw_steps(loops), frame=frame, peaks=listing_text(peaks))]


def _draw_poles(designs: Sequence[Any], reach: float) -> Figure:
    """Draw the poles of the closed loop and of the controller of each design."""
    columns = count_columns(len(designs))
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 361))
    real, imaginary = (
        {"label": f"{part} part", "unit": "-", "low": -reach, "high": reach}
        for part in ("real", "imaginary")
    )
    with drawing([square_in(columns)] * len(designs), columns=columns) as panels:
        for panel, (one, (loop, controller)) in zip(panels, designs, strict=True):
            title = one.name if one.stable else f"{one.name}: unstable"
            panel.set_axes(real, imaginary, title=title, equal=True)
            panel.curve("unit circle", turn.real, turn.imag, look=None, width=1.0, numbers=False)
            points: dict[str, Any] = {"line": False, "filled": False, "size": 6.0}
            own = {"look": 1, "marker": "o", **points}
            panel.curve("controller alone", controller.real, controller.imag, **own)
            panel.curve("closed loop", loop.real, loop.imag, look=0, marker="x", **points)
    return panels[0].figure


def _simulation_blocks(report: DesignReport) -> list[Block]:
    """Return series and spectra of the simulated loops."""
    settings = report.config.settings.simulation
    runs = [(one, one.run) for one in report.assessments if one.run is not None]
    if not runs:
        return ["No loop is stable, so none was simulated."]
    rate_hz, frames = runs[0][1].frame_rate_hz, runs[0][1].residual_nm.shape[1]
    residuals = [
        f"{one.name} {nm_text(float(np.sqrt(np.mean(run.rms_nm**2))), '.1f', unit='nm rms')}"
        for one, run in runs
    ]
    time_s = np.arange(min(frames, _EXCERPT)) / rate_hz
    facts = {"duration": f"{time_s[-1]:.2f}", "residuals": listing_text(residuals)}
    reach = 1.05 * max(float(np.max(np.abs(run.residual_nm[0, :_EXCERPT, 0]))) for _, run in runs)
    residual = {"label": "residual", "unit": "nm", "low": -reach, "high": reach}
    text = f"{count_text(settings.cases, 'run')} of {frames} frames each, seed {settings.seed}."
    series: list[Block] = []
    spectra: list[Block] = []
    for number, batch in _sheets(runs):
        with drawing([0.95] * len(batch)) as panels:
            for panel, (one, run) in zip(panels, batch, strict=True):
                panel.set_axes(TIME, residual, title=one.name)
                style: dict[str, Any] = {"look": report.names.index(one.name), "dash": 0}
                y = run.residual_nm[0, :_EXCERPT, 0]
                panel.curve("residual", time_s, y, quiet=True, width=0.9, **style)
        series.append(chart(f"series{number}", panels[0].figure, **facts))
        columns = count_columns(len(batch))
        with drawing([2.2] * len(batch), columns=columns) as panels:
            for panel, (one, run) in zip(panels, batch, strict=True):
                panel.set_axes(FREQUENCY, SPECTRUM, title=one.name)
                f, opened, left, exact = run_spectra(run, one.loop, report.config.truth)
                panel.curve("before the correction", f, opened, look=None, width=0.8)
                panel.curve("residual, simulated", f, left, look=5, dash=0)
                panel.curve("residual, exact", f, exact, look=1, width=1.4)
        spectra.append(chart(f"spectra{number}", panels[0].figure))
    return [text, *series, *spectra]


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
    compared = compare_in_truth(designs, config)
    opening = _truth_blocks(config, compared, ("phase_margin_deg",))
    if compared.limit is not None:
        least = nm_text(compared.limit.rms_nm, ".1f", unit="nm rms")
        opening.insert(0, f"No controller of the loop's own sensor alone leaves less than {least}.")
    sections: dict[str, tuple[str, Sequence[Block]]] = {"summary": ("Summary", opening)}
    for number, (name, design) in enumerate(designs.items(), start=1):
        failures = design.tables()[0]
        blocks: tuple[Block, ...] = (
            fact_table(name, design.facts()),
            row_table(failures.title, failures.rows),
            _failure_chart(config, name, design, f"failures-{number}"),
            row_table("Certificate, computed again", design.recertify().checks),
        )
        sections[f"design-{number}"] = (name, blocks)
    page = Page(
        title=title or f"Several sensors for {config.source.name}",
        subtitle=f"{listing_text(list(designs))}. Made {time_text(creation_time())}.",
        sections={**sections, **source_section(files, texts={source[0]: text})},
    )
    return write_page(page, path, pdf), compared


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
        sensor_failure_figure(simulation, [segment for segment, _ in rows], exact_nm),
        group="sensor-failures",
        name=name,
        away=f"{_AWAY_S:g}",
        residuals=listing_text(left),
    )
