"""Charts of poles, and of the answers to a step."""

from __future__ import annotations

import numpy as np

from lbt_synth.report.designs.design_curves import count_columns, design_curve, split_by_sheets
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.designs.simulation import STEP_NM
from lbt_synth.report.number_text import fixed_text, listing_text, number_text
from lbt_synth.report.page.charts import Axis, Chart, Curve, Panel


def pole_and_step_charts(report: DesignReport) -> list[Chart]:
    """Poles, and answers to a step."""
    turn = np.linspace(0, 2 * np.pi, 361)
    circle = Curve(
        name="unit circle", x=np.cos(turn), y=np.sin(turn), look=None, width=1.0, hover=False
    )
    poles = [np.append(one.loop_poles, one.controller_poles) for one in report.assessments]
    reach = 1.06 * max(1.0, *(float(np.max(np.abs(values))) for values in poles))
    panels = [
        Panel(
            title=one.name if one.stable else f"{one.name}: unstable",
            x=Axis(label="real part", unit="-", low=-reach, high=reach),
            y=Axis(label="imaginary part", unit="-", low=-reach, high=reach),
            equal=True,
            marks=(
                circle,
                Curve(
                    name="controller alone",
                    x=one.controller_poles.real,
                    y=one.controller_poles.imag,
                    look=1,
                    line=False,
                    marker="circle",
                    filled=False,
                    size=6.0,
                ),
                Curve(
                    name="closed loop",
                    x=one.loop_poles.real,
                    y=one.loop_poles.imag,
                    look=0,
                    line=False,
                    marker="cross",
                    size=5.0,
                ),
            ),
        )
        for one in report.assessments
    ]
    radii = [f"{one.name} {number_text(one.spectral_radius, 6)}" for one in report.assessments]
    charts = list(
        split_by_sheets(
            Chart(
                key="poles",
                title="Poles",
                caption="Poles of the closed loop (crosses) at the real sensor gain and of the "
                "controller by itself (circles). The loop is stable if all crosses lie inside the "
                "unit circle; near 1 they are slow, near the circle lightly damped.",
                alt="One complex plane per design, with the unit circle. Largest modulus of the "
                f"closed loop's poles: {listing_text(radii)}.",
                panels=tuple(panels),
                columns=count_columns(len(panels)),
            )
        )
    )
    if report.stable:
        charts.append(_step_chart(report))
    return charts


def _step_chart(report: DesignReport) -> Chart:
    time = Axis(label="time after the step", unit="ms")
    rows = [(one, report.simulations[one.name]) for one in report.stable]
    peaks = [
        f"{one.name} {fixed_text(float(np.max(np.abs(run.step_residual_nm[5:]))), 0)} nm"
        for one, run in rows
    ]
    residuals = [
        design_curve(report, one, 1e3 * run.step_time_s, run.step_residual_nm, step=True)
        for one, run in rows
    ]
    commands = [
        design_curve(report, one, 1e3 * run.step_time_s, run.step_command_nm, step=True)
        for one, run in rows
    ]
    return Chart(
        key="step",
        title="Answer to a step",
        caption=f"The disturbance of the first axis steps by {STEP_NM:g} nm; nothing else moves, "
        "and there is no noise. Residual (above) and command (below) in frames of "
        f"{number_text(1e3 / report.config.hardware.frame_rate_hz)} ms. A controller with a model "
        "of a vibration rings at its frequency.",
        alt="Two panels over time, one curve per design. Largest residual from the sixth frame on: "
        f"{listing_text(peaks)}.",
        panels=(
            Panel(x=time, y=Axis(label="residual", unit="nm"), marks=tuple(residuals)),
            Panel(x=time, y=Axis(label="command", unit="nm"), marks=tuple(commands)),
        ),
    )
