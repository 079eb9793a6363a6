"""Charts of the transfer functions of designs and of their loops."""

from __future__ import annotations

import numpy as np

from lbt_synth.report.designs.design_curves import FREQUENCY, design_curve
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.number_text import listing_text, number_text
from lbt_synth.report.page.charts import Axis, Chart, Mark, Panel, Rule


def transfer_charts(report: DesignReport) -> list[Chart]:
    """Singular values of the estimation error, and of the closed loops."""
    norms = {one.name: one.error_norms for one in report.assessments if one.error_norms is not None}
    charts = []
    if norms:
        peaks = [f"{name} {number_text(float(np.max(n)), 3)} nm" for name, n in norms.items()]
        marks: list[Mark] = [
            *_vibration_rules(report),
            *(
                design_curve(report, one, report.frequency_hz, norms[one.name])
                for one in report.assessments
                if one.name in norms
            ),
        ]
        y = Axis(label="largest singular value", unit="nm", log=True)
        charts.append(
            Chart(
                key="sigma",
                title="Estimation error of the design models",
                caption="Largest singular value from the disturbances that each design assumes "
                "(of unit size) to the error of its estimate; of an LQG, to its residual. The "
                "peak is the H-infinity norm, the area under the square the variance. Designs "
                "that estimate nothing, such as integrators and shaped controllers, have none.",
                alt="Curves over frequency, one per design that estimates. Peaks on this grid: "
                f"{listing_text(peaks)}.",
                panels=(Panel(x=FREQUENCY, y=y, marks=tuple(marks)),),
            )
        )
    if report.stable:
        charts.append(_loop_chart(report))
    return charts


def _loop_chart(report: DesignReport) -> Chart:
    rejections, noises = (
        [
            design_curve(report, one, report.frequency_hz, getattr(one, name))
            for one in report.assessments
        ]
        for name in ("rejection", "noise_transfer")
    )
    marks = _vibration_rules(report)
    return Chart(
        key="loop",
        title="Rejection and noise of the closed loops",
        caption="Largest singular value at the real sensor gain of "
        f"{number_text(report.real_gain)}: from the phase to "
        "the residual (above; below 1 a disturbance is reduced) and from the measurement noise "
        "to the residual (below). With several axes it is that of the worst one.",
        alt="Two panels over frequency, one curve per design. "
        + _largest_text(report, "rejection", "Largest rejection")
        + " "
        + _largest_text(report, "noise_transfer", "Largest noise transfer"),
        panels=(
            Panel(
                x=FREQUENCY,
                y=Axis(label="phase to residual", unit="-", log=True),
                marks=(Rule(name="", at=1.0, axis="y"), *marks, *rejections),
            ),
            Panel(
                x=FREQUENCY,
                y=Axis(label="noise to residual", unit="-", log=True),
                marks=(*marks, *noises),
            ),
        ),
    )


def _vibration_rules(report: DesignReport) -> list[Rule]:
    lines = sorted({line.frequency_hz for line in report.config.truth.vibrations})  # type: ignore[union-attr]
    name = "true vibration" if len(lines) == 1 else "true vibrations"
    return [Rule(name=name, at=frequency, dash=3) for frequency in lines]


def _largest_text(report: DesignReport, name: str, words: str) -> str:
    parts = [
        f"{one.name} {number_text(float(np.max(getattr(one, name))), 3)}" for one in report.stable
    ]
    return f"{words}: {listing_text(parts)}."
