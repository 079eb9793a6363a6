"""Curves in the look of their design, and charts with a panel per design."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lbt_synth.report.designs.assessment import DesignAssessment
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.page.charts import Axis, Chart, Curve
from lbt_synth.validation import FloatArray

FREQUENCY = Axis(label="frequency", unit="Hz", log=True)
_PANELS = 6  # of one chart that has a panel per design: they fit a sheet


def design_curve(
    report: DesignReport,
    one: DesignAssessment,
    x: FloatArray,
    y: FloatArray | None,
    *,
    step: bool = False,
) -> Curve:
    """Curve of a design in its own look; without values it is in the legend as unstable."""
    look = look_number(report, one)
    if y is None:
        return Curve(name=f"{one.name}: unstable", x=np.zeros(0), y=np.zeros(0), look=look)
    return Curve(name=one.name, x=x, y=y, look=look, step=step)


def look_number(report: DesignReport, one: DesignAssessment) -> int:
    """Return the number of the look of a design: its place in the report."""
    return [other.name for other in report.assessments].index(one.name)


def count_columns(panels: int) -> int:
    """Return how many panels stand side by side: three, but two if there are four."""
    return 2 if panels == 4 else min(panels, 3)


def split_by_sheets(chart: Chart) -> Iterator[Chart]:
    """Split a chart into charts that each fit a sheet of paper."""
    parts = [chart.panels[i : i + _PANELS] for i in range(0, len(chart.panels), _PANELS)]
    for number, panels in enumerate(parts):
        part = replace(chart, panels=panels)
        if number:
            part = replace(
                part, key=f"{chart.key}-{number + 1}", title=f"{chart.title} (continued)"
            )
        yield part
