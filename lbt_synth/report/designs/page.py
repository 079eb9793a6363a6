"""Pages of designs: their sections, charts and words, and their files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.loop.simulation import Drop
from lbt_synth.models.sensor_suite import OWN_SENSOR
from lbt_synth.report.designs.report import DesignAssessment, DesignReport, summary_table, verdict
from lbt_synth.report.draw import Figure, count_columns, drawing, square_in
from lbt_synth.report.figures.loops import (
    draw_bode,
    draw_design,
    draw_sigma,
    draw_steps,
    sigma_curves,
)
from lbt_synth.report.figures.records import (
    SERIES_S,
    sensor_failure_figure,
    simulation_figure,
)
from lbt_synth.report.figures.studies import (
    FREQUENCY_ERROR,
    SENSOR_GAIN,
    limits_figure,
    robustness_map_figure,
    strehl_axis,
)
from lbt_synth.report.page.html import (
    Block,
    Chart,
    Notice,
    Page,
    chart,
    new_page,
    paragraph,
    survival_blocks,
)
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import row_table
from lbt_synth.storage.words import count_text, listing_text
from lbt_synth.studies.robustness import run_failures


def design_page(report: DesignReport, *, title: str | None = None) -> Page:
    """Return the page of a report; :func:`write_page` writes it.

    Parameters
    ----------
    report : DesignReport
        Result of :func:`design_report`.
    title : str, optional
        Heading of the page; by default it names the configuration.

    Returns
    -------
    Page
        The page.

    Raises
    ------
    ProblemError
        If the title is empty.
    FileError
        If the configuration or a gain file cannot be read again.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = lbt.design.optimal_integrator(config.hardware, config.truth)
    >>> report = lbt.report.design_report(config, {"integrator": slow})
    >>> lbt.report.design_page(report, title="Tonight").title
    'Tonight'
    """
    source = report.config.source.name
    heading = f"Controllers for {source}" if title is None else title.strip()
    if not heading:
        raise ProblemError("title must hold at least one letter; got an empty text.")
    return new_page(
        heading,
        f"{count_text(len(report.assessments), 'design')}: {listing_text(report.names)}",
        {
            "Summary": _summary_blocks(report),
            "When sensors fail": _failure_blocks(report),
            "Transfer functions": _transfer_blocks(report),
            "Robustness": _robustness_charts(report),
            "Dynamics": _dynamics_charts(report),
            "Simulation": _simulation_blocks(report),
            "Certificates": _certificate_blocks(report),
        },
        sources=[
            (report.config.source, "configuration"),
            *((path, f"gain file of {name}") for name, path in report.gain_files.items()),
        ],
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
        *_truth_blocks(report),
        *report.config._summarise().tables,
        *(
            Notice(text=f"{one.name} was {note}")
            for one in report.assessments
            for note in one.notes
        ),
    ]


def _truth_blocks(report: DesignReport) -> list[Block]:
    """Return the designs beside reference designs, and what is wrong with them in the truth."""
    config, limits = report.config, report.limits
    caption = f"In the truth of {config.source.name}; {config.imaging.label}"
    hidden = ("worst_nm", "above_band_limit_percent", "method", "stable")
    stable = {one.name for one in report.stable}
    blocks: list[Block] = [row_table(caption, limits.rows, without=hidden)]
    if limits.limit is not None and any(not one.alone for one in report.assessments):
        least = nm_text(limits.limit.rms_nm, ".1f", unit="nm rms")
        blocks.append(f"No controller of the loop's own sensor alone leaves less than {least}.")
    return [
        *blocks,
        *(
            Notice(text=f"{name}: {text}.")
            for name, texts in limits.warnings.items()
            if name in stable  # an unstable loop is named above
            for text in texts
        ),
        *(Notice(text=note) for note in limits.notes),
    ]


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
    alone = [one for one in report.assessments if one.alone]
    designs = {one.name: one.design for one in alone}
    loops = {one.name: one.loop for one in alone}
    curves = sigma_curves(designs, loops, lines_hz=lines_hz)
    blocks: list[Block] = []
    if alone and not any(one.stable for one in alone):
        loops = {}
        blocks.append("No loop is stable, so none has a rejection or a noise transfer.")
    if loops or any(error is not None for _, error, *_ in curves.values()):
        line = "true vibration" if len(lines_hz) == 1 else "true vibrations"
        figure = draw_sigma(curves, loops, lines_hz, line=line)
        blocks.append(chart("sigma", figure, gain=gain))
    if loops:
        blocks.append(chart("bode", draw_bode(loops), gain=gain))
    return blocks


def _robustness_charts(report: DesignReport) -> list[Chart]:
    """Strehl ratio and residual over the frequency error, and maps with the sensor gain."""
    maps = {one.name: one.map for one in report.assessments if one.map is not None}
    if report.errors_hz.size == 1:
        return [_strehl_chart(report)] if maps else []
    charts = []
    if any(one.stable for one in report.assessments if one.alone):
        charts.append(_strehl_chart(report))
    if report.stable:
        charts.append(chart("limits", limits_figure(report.limits, over_errors=True)))
    if maps:
        figure = robustness_map_figure(maps, real_gain=report.real_gain)
        charts.append(chart("map", figure))
    return charts


def _strehl_chart(report: DesignReport) -> Chart:
    """Strehl ratio over the frequency error, or the sensor gain for a truth without vibrations."""
    by_gain = report.errors_hz.size == 1
    drawn = [one for one in report.assessments if one.map is not None]
    curves = {
        one.name: (one.map.sensor_gains, 100 * one.map.strehl[0, :, 0])
        if by_gain
        else (report.errors_hz, 100 * one.strehls)
        for one in drawn
        if one.map is not None and (by_gain or one.stable)
    }
    axis = strehl_axis(np.concatenate([percents for _, percents in curves.values()]))
    with drawing([2.5]) as (panel,):
        panel.set_axes(SENSOR_GAIN if by_gain else FREQUENCY_ERROR, axis)
        for one in drawn:
            draw_design(panel, report.names, one.name, *curves.get(one.name, ((), None)))
        if by_gain:
            panel.rule("real sensor gain", report.real_gain, dash=3)
    key = "sensor-gain" if by_gain else "robustness"
    return chart(key, panel.figure, gain=f"{report.real_gain:.4g}")


def _dynamics_charts(report: DesignReport) -> list[Chart]:
    """Poles, and step responses."""
    alone = [one for one in report.assessments if one.alone]
    charts = [chart("poles", _draw_poles(alone))] if alone else []
    loops = {one.name: one.loop for one in alone if one.stable}
    if not loops:
        return charts
    frame = f"{1e3 / report.config.hardware.frame_rate_hz:.4g}"
    return [*charts, chart("step", draw_steps(loops), frame=frame)]


def _draw_poles(designs: Sequence[DesignAssessment]) -> Figure:
    """Draw the poles of the closed loop and of the controller of each design."""
    poles = [(one.loop.system.poles, np.linalg.eigvals(one.design.controller.A)) for one in designs]
    reach = 1.06 * max(
        1.0, float(np.max(np.abs(np.concatenate([p for both in poles for p in both]))))
    )
    columns, turn = count_columns(len(designs)), np.exp(1j * np.linspace(0, 2 * np.pi, 361))
    real, imaginary = (
        {"label": f"{part} part", "unit": "-", "low": -reach, "high": reach}
        for part in ("real", "imaginary")
    )
    points: dict[str, Any] = {"line": False, "filled": False, "size": 6.0}
    with drawing([square_in(columns)] * len(designs), columns=columns) as panels:
        for panel, one, (loop, controller) in zip(panels, designs, poles, strict=True):
            title = one.name if one.stable else f"{one.name}: unstable"
            panel.set_axes(real, imaginary, title=title, equal=True)
            panel.curve("unit circle", turn.real, turn.imag, look=None, width=1.0, numbers=False)
            rings = {"look": 1, "marker": "o", **points}
            panel.curve("controller alone", controller.real, controller.imag, **rings)
            panel.curve("closed loop", loop.real, loop.imag, look=0, marker="x", **points)
    return panels[0].figure


def _simulation_blocks(report: DesignReport) -> list[Block]:
    """Return series and spectra of the simulated loops."""
    settings, truth = report.config.settings.simulation, report.config.truth
    blocks: list[Block] = []
    for number, one in enumerate(report.assessments, start=1):
        if one.run is not None:
            frames = one.run.residual_nm.shape[1]
            text = f"{count_text(settings.cases, 'run')} of {frames} frames each, seed "
            blocks = blocks or [f"{text}{settings.seed}."]
            exact: dict[str, Any] = {"loop": one.loop, "truth": truth} if one.alone else {}
            figure = simulation_figure(one.run, title=one.name, **exact)
            key = f"simulation-{number}"
            blocks.append(chart(key, figure, group="simulation", name=one.name))
    return blocks or ["No loop is stable, so none was simulated."]


def _failure_blocks(report: DesignReport) -> list[Block]:
    """Return what designs of several sensors leave while some fail."""
    blocks: list[Block] = []
    for number, one in enumerate(report.assessments, start=1):
        if not one.alone:
            failures = one.design.tables()[0]
            blocks += [
                row_table(f"{one.name}: {failures.title}", failures.rows),
                _failure_chart(report.config, one.name, one.design, f"failures-{number}"),
            ]
    return blocks


def _failure_chart(config: Config, name: str, design: Design, key: str) -> Chart:
    """Draw a run in which each sensor and channel is missing in turn."""
    units = (OWN_SENSOR, *design.other_sensors)
    drops = [
        Drop(unit=unit, start_s=(2 * i + 1) * SERIES_S, end_s=(2 * i + 2) * SERIES_S)
        for i, unit in enumerate(units)
    ]
    seconds = (2 * len(units) + 1) * SERIES_S
    frames, seed = int(seconds * config.hardware.frame_rate_hz), config.settings.simulation.seed
    simulation, rows = run_failures(
        design, config, config.truth, drops, frames=frames, cases=1, seed=seed
    )
    exact_nm = [row.exact_nm for _, row in rows]
    return chart(
        key,
        sensor_failure_figure(simulation, [segment for segment, _ in rows], exact_nm),
        group="sensor-failures",
        name=name,
        away=f"{SERIES_S:g}",
    )
