"""Charts of a diagnosis: residuals, costs, and the identified spectrum."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from lbt_synth.design import Design
from lbt_synth.identification import Diagnosis
from lbt_synth.linear import Controller
from lbt_synth.report.charts.description import Axis, Bars, Chart, Curve, Mark, Panel
from lbt_synth.report.figures.identification import identification_panels
from lbt_synth.report.number_text import number_text
from lbt_synth.report.page.words import chart
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.words import listing_text

_POINTS = 400  # bands of a curve on a page, each with its least and its largest value
_RESIDUAL = Axis(label="residual", unit="nm rms", low=0)
_ROW_IN = 0.42  # height of a category
_SIGMAS = 2.0


def residual_charts(found: Diagnosis) -> list[Chart]:
    """Return bars of the residuals on unseen data, and of the parts of the disturbance."""
    charts = []
    if rows := found.residuals:
        values = np.array([row.replayed_nm for row in rows])
        errors = _SIGMAS * np.array([row.replayed_error_nm for row in rows])
        bars: tuple[Bars, ...] = (
            Bars(name="data", values=values, low=values - errors, high=values + errors),
            Bars(name="model", values=np.array([row.model_nm for row in rows]), look=1),
        )
        names = [row.name for row in rows]
        shown = np.where(np.isfinite(values), values, [row.model_nm for row in rows])
        pairs = zip(names, shown.tolist(), strict=True)  # the limit has no data
        said = [f"{name} {nm_text(value_nm, '.1f')}" for name, value_nm in pairs]
        charts.append(chart("residuals", [_bar_panel(bars, names)], values=listing_text(said)))
    if costs := found.costs:
        columns = {"loop that ran": "running_nm", "best design": "best_nm"}
        bars = tuple(
            Bars(name=name, values=np.array([getattr(row, field) for row in costs]), look=look)
            for look, (name, field) in enumerate(columns.items())
        )
        said = [
            f"{row.part} {nm_text(row.running_nm, '.1f')} and {nm_text(row.best_nm, '.1f')}"
            for row in costs
        ]
        panel = _bar_panel(bars, [row.part for row in costs])
        best = found.best or "none"
        charts.append(chart("costs", [panel], values=listing_text(said), best=best))
    return charts


def _bar_panel(bars: tuple[Bars, ...], names: list[str]) -> Panel:
    return Panel(
        x=_RESIDUAL,
        y=Axis(label=""),
        marks=bars,
        categories=tuple(names),
        height_in=_ROW_IN * max(len(names), 2),
    )


def spectrum_charts(found: Diagnosis) -> list[Chart]:
    """Return the chart of the identified model."""
    model = found.model
    if model is None:
        return []
    designs: Mapping[str, Controller | Design] = {}
    if found.best_design is not None:
        designs = {found.best: found.best_design}
    panels = [
        replace(panel, marks=tuple(map(_thin_curve, panel.marks)))
        for panel in identification_panels(model, designs)
    ]
    lines = [f"{number_text(line.row.frequency_hz)} Hz" for line in found.lines]
    words = listing_text(lines) or "none"
    return [chart("identification", panels, columns=len(model.axes), lines=words)]


def _thin_curve(mark: Mark) -> Mark:
    """Return a curve of many points with the least and the largest value of each band."""
    if not isinstance(mark, Curve) or mark.x.size <= 4 * _POINTS:
        return mark
    edges = np.searchsorted(mark.x, np.geomspace(mark.x[0], mark.x[-1], _POINTS))
    kept = {0, mark.x.size - 1}
    for start, stop in pairwise(edges.tolist()):
        if stop > start:
            band = mark.y[start:stop]
            kept |= {start + int(np.argmin(band)), start + int(np.argmax(band))}
    where = np.array(sorted(kept))
    return replace(mark, x=mark.x[where], y=mark.y[where])
