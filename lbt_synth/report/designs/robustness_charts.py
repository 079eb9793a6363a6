"""Charts of Strehl ratio and residual over frequency error and sensor gain."""

from __future__ import annotations

import numpy as np

from lbt_synth.report.designs.assessment import DesignAssessment
from lbt_synth.report.designs.design_curves import count_columns, design_curve, split_by_sheets
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.map_cells import STREHL_LEVELS, strehl_scale
from lbt_synth.report.number_text import fixed_text, listing_text, number_text, signed_text
from lbt_synth.report.page.charts import Axis, Chart, Map, Mark, Panel, Rule

_ERROR = Axis(label="frequency error, design less truth", unit="Hz")
_STREHL_LABEL = "Strehl ratio"


def robustness_charts(report: DesignReport) -> list[Chart]:
    """Strehl ratio and residual over the frequency error, and maps with the sensor gain."""
    if report.errors_hz.size == 1:
        return [_sensor_gain_chart(report)]
    charts = [_strehl_chart(report), _residual_chart(report)] if report.stable else []
    return [*charts, *_map_charts(report)]


def _strehl_chart(report: DesignReport) -> Chart:
    ends = [
        f"{one.name} falls to {fixed_text(100 * float(np.min(one.curve.strehl)), 1)} % at "
        f"{signed_text(float(one.curve.errors_hz[int(np.argmin(one.curve.strehl[0, 0]))]))} Hz"
        for one in report.stable
    ]
    worst = 100 * min(float(np.min(one.curve.strehl)) for one in report.stable)
    low = max(0.0, 10 * np.floor((worst - 5) / 10))
    curves = [
        design_curve(
            report, one, one.curve.errors_hz, 100 * one.curve.strehl[0, 0] if one.stable else None
        )
        for one in report.assessments
    ]
    y = Axis(label=_STREHL_LABEL, unit="%", low=low)
    return Chart(
        key="robustness",
        title="Strehl ratio over the frequency error",
        caption="Exact long-exposure Strehl ratio with every true vibration moved below the "
        "frequency that the design believes by the error, its rms kept, at the real sensor gain of "
        f"{number_text(report.real_gain)}.",
        alt=f"One curve per design. {listing_text(ends)}.",
        panels=(Panel(x=_ERROR, y=y, marks=tuple(curves), height_in=2.5),),
    )


def _residual_chart(report: DesignReport) -> Chart:
    study = report.limits
    marks: list[Mark] = []
    if study.limit is not None and study.limit.rms_nm > 0:
        marks.append(Rule(name="limit, frequency known", at=study.limit.rms_nm, axis="y", dash=3))
    if study.band is not None:
        name = "limit, frequency anywhere in this range"
        marks.append(Rule(name=name, at=study.band.rms_nm, axis="y", dash=1))
    for one, curve in zip(report.assessments, study.residual_nm, strict=True):
        values = curve[::-1] if one.stable else None
        marks.append(design_curve(report, one, -study.shift_hz[::-1] + 0.0, values))
    limits = [
        f"{rule.name} {fixed_text(rule.at, 1)} nm" for rule in marks if isinstance(rule, Rule)
    ]
    worst = [f"{row.design} {fixed_text(row.worst_nm, 1)} nm" for row in study.rows if row.stable]
    y = Axis(label="residual", unit="nm rms", log=True)
    return Chart(
        key="limits",
        title="Residual over the frequency error, beside the limits",
        caption="Exact residual. The lines are what no linear controller goes below: one that is "
        "given the frequency, and one that has to serve the whole range. Where a limit cannot be "
        "computed it is not drawn.",
        alt=f"One curve per design. Worst residuals: {listing_text(worst)}."
        + (f" Limits: {listing_text(limits)}." if limits else ""),
        panels=(Panel(x=_ERROR, y=y, marks=tuple(marks), height_in=2.5),),
    )


def _map_charts(report: DesignReport) -> list[Chart]:
    low, high = strehl_scale([one.map.strehl for one in report.assessments])
    panels = []
    for one in report.assessments:
        found = Map(
            x=one.map.errors_hz,
            y=one.map.sensor_gains,
            values=100 * one.map.strehl[0],
            label=_STREHL_LABEL,
            unit="%",
            low=low,
            high=high,
            levels=STREHL_LEVELS,
            blank="unstable loop",
        )
        rule = Rule(name="real sensor gain", at=report.real_gain, axis="y", dash=1)
        inside = found.y[0] <= report.real_gain <= found.y[-1]
        panels.append(
            Panel(
                title=one.name,
                x=Axis(label="frequency error", unit="Hz"),
                y=Axis(label="sensor gain", unit="-"),
                marks=(found, rule) if inside else (found,),
                height_in=2.3,
            )
        )
    words = [_map_text(one) for one in report.assessments]
    return list(
        split_by_sheets(
            Chart(
                key="map",
                title="Strehl ratio over frequency error and sensor gain",
                caption="One scale of colours for all designs; lines at round values. Sensor gains "
                "are relative to the sensor matrix of the configuration. Hatched: the loop is "
                "unstable there.",
                alt=f"One map per design. {' '.join(words)}",
                panels=tuple(panels),
                columns=count_columns(len(panels)),
            )
        )
    )


def _map_text(one: DesignAssessment) -> str:
    values = one.map.strehl[np.isfinite(one.map.strehl)]
    if not values.size:
        return f"{one.name}: unstable everywhere."
    return (
        f"{one.name}: {fixed_text(100 * float(values.min()), 1)} to "
        f"{fixed_text(100 * float(values.max()), 1)} %, stable at {int(one.map.stable.sum())} of "
        f"{one.map.stable.size} sensor gains."
    )


def _sensor_gain_chart(report: DesignReport) -> Chart:
    """Strehl ratio over the sensor gain, drawn for a truth without vibrations."""
    words = [_map_text(one) for one in report.assessments]
    marks: list[Mark] = [
        Rule(name="real sensor gain", at=report.real_gain, dash=3),
        *(
            design_curve(report, one, one.map.sensor_gains, 100 * one.map.strehl[0, :, 0])
            for one in report.assessments
        ),
    ]
    x = Axis(label="sensor gain", unit="-")
    y = Axis(label=_STREHL_LABEL, unit="%", low=0.0)
    return Chart(
        key="sensor-gain",
        title="Strehl ratio over the sensor gain",
        caption="Exact long-exposure Strehl ratio. Sensor gains are relative to the sensor matrix "
        "of the configuration. Curves end where the loop becomes unstable.",
        alt=f"One curve per design. {' '.join(words)}",
        panels=(Panel(x=x, y=y, marks=tuple(marks), height_in=2.5),),
    )
