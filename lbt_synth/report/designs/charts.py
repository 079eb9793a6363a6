"""Charts of a report of designs, built like the figures of :mod:`lbt_synth.report.figures`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lbt_synth.loop import close_loop
from lbt_synth.report.charts.description import Axis, Chart, Curve, Panel, Rule
from lbt_synth.report.charts.scales import count_columns
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.designs.simulation import STEP_NM
from lbt_synth.report.figures.loop import (
    frequency_panel,
    loop_panels,
    stable_curve,
    vibration_rules,
)
from lbt_synth.report.figures.open_loops import bode_panels, break_loop
from lbt_synth.report.figures.robustness import FREQUENCY_ERROR, map_panels, strehl_panel
from lbt_synth.report.figures.simulation import series_panel, spectra_panel
from lbt_synth.report.figures.studies import limits_panel
from lbt_synth.report.number_text import fixed_text, number_text, signed_text
from lbt_synth.report.page.words import chart
from lbt_synth.storage.display_unit import nm_text, shown_unit
from lbt_synth.storage.words import listing_text

_PANELS = 6  # of one chart that has a panel per design: they fit a sheet


def transfer_charts(report: DesignReport) -> list[Chart]:
    """Singular values of the estimation error, and of the closed loops."""
    norms = {one.name: one.error_norms for one in report.assessments if one.error_norms is not None}
    names, f = report.names, report.frequency_hz
    lines = report.config.truth.lines_hz
    rules = vibration_rules(lines, "true vibration" if len(lines) == 1 else "true vibrations")
    charts = []
    if norms:
        curves = [stable_curve(name, names, f, values) for name, values in norms.items()]
        peaks = [f"{name} {nm_text(float(np.max(n)))}" for name, n in norms.items()]
        panel = frequency_panel("disturbances to error", "nm", curves, rules)
        charts.append(chart("sigma", [panel], peaks=listing_text(peaks)))
    if report.stable:
        responses = {one.name: (f, one.rejection, one.noise_transfer) for one in report.assessments}
        charts.append(
            chart(
                "loop",
                loop_panels(responses, rules, names),
                gain=number_text(report.real_gain),
                rejection=_largest_text(report, "rejection"),
                noise=_largest_text(report, "noise_transfer"),
            )
        )
        charts.append(_bode_chart(report))
    return charts


def _bode_chart(report: DesignReport) -> Chart:
    """Gain and phase of the loops, with their margins marked."""
    hardware, gain = report.config.hardware, report.config.truth.sensor_gain
    loops = [
        each
        for look, one in enumerate(report.assessments)
        for each in break_loop(
            one.name, close_loop(hardware, one.design.controller, sensor_gain=gain), look
        )
    ]
    margins = [f"{each.name} {each.margins}" for each in loops]
    return chart(
        "bode",
        bode_panels(loops),
        gain=number_text(report.real_gain),
        margins=listing_text(margins),
    )


def _largest_text(report: DesignReport, name: str) -> str:
    """Return the largest value of a transfer function of each stable design."""
    largest = {one.name: float(np.max(getattr(one, name))) for one in report.stable}
    return listing_text([f"{name} {number_text(value, 3)}" for name, value in largest.items()])


def robustness_charts(report: DesignReport) -> list[Chart]:
    """Strehl ratio and residual over the frequency error, and maps with the sensor gain."""
    if report.errors_hz.size == 1:
        return [_sensor_gain_chart(report)]
    charts = [_strehl_chart(report), _residual_chart(report)] if report.stable else []
    maps = {one.name: one.map for one in report.assessments}
    panels = map_panels(maps, real_gain=report.real_gain)
    found = chart("map", panels, columns=count_columns(len(maps)), ranges=_map_texts(report))
    return [*charts, *_split_by_sheets(found)]


def _strehl_chart(report: DesignReport) -> Chart:
    worst = {one.name: one.curve.strehl[0, 0] for one in report.stable}
    ends = [
        f"{name} falls to {fixed_text(100 * float(np.min(strehl)), 1)} % at "
        f"{signed_text(float(report.errors_hz[np.argmin(strehl)]))} Hz"
        for name, strehl in worst.items()
    ]
    curves = [
        stable_curve(
            one.name,
            report.names,
            one.curve.errors_hz,
            100 * one.curve.strehl[0, 0] if one.stable else None,
        )
        for one in report.assessments
    ]
    panel = strehl_panel(curves)
    gain = number_text(report.real_gain)
    return chart("robustness", [panel], gain=gain, ends=listing_text(ends))


def _residual_chart(report: DesignReport) -> Chart:
    study = report.limits
    panel = limits_panel(study, FREQUENCY_ERROR, study.shift_hz, str)
    _, factor = shown_unit("nm")
    limits = [  # of the panel, which are in the unit that is shown
        f"{rule.name} {nm_text(rule.at / factor, '.1f')}" for rule in panel.select(Rule)
    ]
    worst = [f"{row.design} {nm_text(row.worst_nm, '.1f')}" for row in study.rows if row.stable]
    return chart(
        "limits",
        [panel],
        worst=listing_text(worst),
        limits=f" Limits: {listing_text(limits)}." if limits else "",
    )


def _map_texts(report: DesignReport) -> str:
    """Say of each design how far its Strehl ratio ranges over its map."""
    texts = []
    for one in report.assessments:
        values = 100 * one.map.strehl[np.isfinite(one.map.strehl)]
        if not values.size:
            texts.append(f"{one.name}: unstable everywhere.")
            continue
        texts.append(
            f"{one.name}: {fixed_text(float(values.min()), 1)} to "
            f"{fixed_text(float(values.max()), 1)} %, stable at {int(one.map.stable.sum())} of "
            f"{one.map.stable.size} sensor gains."
        )
    return " ".join(texts)


def _sensor_gain_chart(report: DesignReport) -> Chart:
    """Strehl ratio over the sensor gain, drawn for a truth without vibrations."""
    marks = [
        stable_curve(one.name, report.names, one.map.sensor_gains, 100 * one.map.strehl[0, :, 0])
        for one in report.assessments
    ]
    panel = Panel(
        x=Axis(label="sensor gain", unit="-"),
        y=Axis(label="Strehl ratio", unit="%", low=0.0),
        marks=(*marks, Rule(name="real sensor gain", at=report.real_gain, dash=3)),
        height_in=2.5,
    )
    return chart("sensor-gain", [panel], ranges=_map_texts(report))


def pole_and_step_charts(report: DesignReport) -> list[Chart]:
    """Poles, and step responses."""
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 361))
    circle = Curve(name="unit circle", x=turn.real, y=turn.imag, look=None, width=1.0, hover=False)
    poles = [np.append(one.loop_poles, one.controller_poles) for one in report.assessments]
    reach = 1.06 * max(1.0, *(float(np.max(np.abs(values))) for values in poles))
    real, imaginary = (
        Axis(label=f"{part} part", unit="-", low=-reach, high=reach)
        for part in ("real", "imaginary")
    )
    ring: dict[str, Any] = {"marker": "circle", "filled": False, "size": 6.0, "look": 1}
    cross: dict[str, Any] = {"marker": "cross", "look": 0}
    panels = []
    for one in report.assessments:
        marks = [circle]
        for name, values, style in (
            ("controller alone", one.controller_poles, ring),
            ("closed loop", one.loop_poles, cross),
        ):
            marks.append(Curve(name=name, x=values.real, y=values.imag, line=False, **style))
        title = one.name if one.stable else f"{one.name}: unstable"
        panels.append(Panel(title=title, x=real, y=imaginary, equal=True, marks=tuple(marks)))
    radii = [f"{one.name} {number_text(one.spectral_radius, 6)}" for one in report.assessments]
    columns = count_columns(len(panels))
    found = chart("poles", panels, columns=columns, radii=listing_text(radii))
    return [*_split_by_sheets(found), *([_step_chart(report)] if report.stable else [])]


def _step_chart(report: DesignReport) -> Chart:
    runs = {one.name: report.simulations[one.name] for one in report.stable}
    peaks = [
        f"{name} {nm_text(float(np.max(np.abs(run.step_residual_nm[5:]))), '.0f')}"
        for name, run in runs.items()
    ]
    panels = []
    for label in ("residual", "command"):
        series = {name: getattr(run, f"step_{label}_nm") for name, run in runs.items()}
        curves = [
            stable_curve(name, report.names, 1e3 * runs[name].step_time_s, y, step="after")
            for name, y in series.items()
        ]
        x = Axis(label="time after the step", unit="ms")
        panels.append(Panel(x=x, y=Axis(label=label, unit="nm"), marks=tuple(curves)))
    return chart(
        "step",
        panels,
        step=nm_text(STEP_NM, ".4g"),
        frame=number_text(1e3 / report.config.hardware.frame_rate_hz),
        peaks=listing_text(peaks),
    )


def simulation_charts(report: DesignReport) -> list[Chart]:
    """Series and spectra of the simulated loops."""
    runs = {one.name: report.simulations[one.name] for one in report.stable}
    if not runs:
        return []
    duration = fixed_text(float(next(iter(runs.values())).time_s[-1]), 2)
    reach = 1.05 * max(float(np.max(np.abs(run.series_nm[:, 0]))) for run in runs.values())
    left = [
        f"{name} {nm_text(run.residual_nm, '.1f', unit='nm rms')}" for name, run in runs.items()
    ]
    series, spectra = [], []
    for name, run in runs.items():
        look, f = report.names.index(name), run.frequency_hz
        curve = Curve(name="", x=run.time_s, y=run.series_nm[:, 0], look=look, width=0.9, dash=0)
        series.append(series_panel([curve], title=name, reach=reach, height_in=0.95))
        curves = (
            Curve(name="before the correction", x=f, y=run.open_nm2_hz, look=None, width=0.8),
            Curve(name="residual, simulated", x=f, y=run.residual_nm2_hz, look=5, dash=0),
            Curve(name="residual, exact", x=f, y=run.exact_nm2_hz, look=1, width=1.4),
        )
        spectra.append(spectra_panel(curves, title=name))
    first = chart("series", series, duration=duration, residuals=listing_text(left))
    second = chart("spectra", spectra, columns=count_columns(len(spectra)))
    return [*_split_by_sheets(first), *_split_by_sheets(second)]


def _split_by_sheets(found: Chart) -> Iterator[Chart]:
    """Split a chart into charts that each fit a sheet of paper."""
    for start in range(0, len(found.panels), _PANELS):
        part = replace(found, panels=found.panels[start : start + _PANELS])
        if start:
            key, title = f"{found.key}-{start // _PANELS + 1}", f"{found.title} (continued)"
            part = replace(part, key=key, title=title)
        yield part
