"""Figures of a report of designs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lbt_synth.report.designs.assessment import DesignAssessment
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.designs.simulation import STEP_NM
from lbt_synth.report.number_text import fixed_text, listing_text, number_text, signed_text
from lbt_synth.report.page.charts import Axis, Chart, Curve, Map, Panel, Rule
from lbt_synth.validation import FloatArray

_PANELS = 6  # of one chart that has a panel a design: they fit a sheet
_LEVELS = (10, 20, 30, 40, 50, 60, 70, 75, 80, 83, 86, 90, 95, 98)  # [%]
_FREQUENCY = Axis(label="frequency", unit="Hz", log=True)
_ERROR = Axis(label="frequency error, design less truth", unit="Hz")
_STREHL = "Strehl ratio"


def transfer_charts(report: DesignReport) -> list[Chart]:
    """Singular values of the estimation error, and of the closed loops."""
    charts = []
    marks = _vibrations(report)
    estimators = [
        _curve(report, one, report.frequency_hz, one.error_norms)
        for one in report.assessments
        if one.error_norms is not None
    ]
    if estimators:
        peaks = [
            f"{one.name} {number_text(float(np.max(one.error_norms)), 3)} nm"
            for one in report.assessments
            if one.error_norms is not None
        ]
        charts.append(
            Chart(
                key="sigma",
                title="Estimation error of the design models",
                caption="Largest singular value from the disturbances that each design assumes "
                "(of unit size) to the error of its estimate; of an LQG, to its residual. The "
                "peak is the H-infinity norm, the area under the square the variance. Designs "
                "that estimate nothing, such as integrators and shaped controllers, have none.",
                alt="Curves over frequency, one a design that estimates. Peaks on this grid: "
                f"{listing_text(peaks)}.",
                panels=(
                    Panel(
                        x=_FREQUENCY,
                        y=Axis(label="largest singular value", unit="nm", log=True),
                        marks=(*marks, *estimators),
                    ),
                ),
            )
        )
    if not report.stable:
        return charts
    gain = number_text(report.real_gain)
    charts.append(
        Chart(
            key="loop",
            title="Rejection and noise of the closed loops",
            caption=f"Largest singular value at the real sensor gain of {gain}: from the phase to "
            "the residual (above; below 1 a disturbance is reduced) and from the measurement noise "
            "to the residual (below). With several axes it is that of the worst one.",
            alt="Two panels over frequency, one curve a design. "
            + _largest(report, "rejection", "Largest rejection")
            + " "
            + _largest(report, "noise_transfer", "Largest noise transfer"),
            panels=(
                Panel(
                    x=_FREQUENCY,
                    y=Axis(label="phase to residual", unit="-", log=True),
                    marks=(
                        Rule(name="", at=1.0, axis="y"),
                        *marks,
                        *(
                            _curve(report, one, report.frequency_hz, one.rejection)
                            for one in report.assessments
                        ),
                    ),
                ),
                Panel(
                    x=_FREQUENCY,
                    y=Axis(label="noise to residual", unit="-", log=True),
                    marks=(
                        *marks,
                        *(
                            _curve(report, one, report.frequency_hz, one.noise_transfer)
                            for one in report.assessments
                        ),
                    ),
                ),
            ),
        )
    )
    return charts


def robustness_charts(report: DesignReport) -> list[Chart]:
    """Strehl ratio and residual over the frequency error, and maps with the sensor gain."""
    if report.errors_hz.size == 1:
        return [_over_gain(report)]
    charts = [_over_error(report), _residuals(report)] if report.stable else []
    return [*charts, *_maps(report)]


def _over_error(report: DesignReport) -> Chart:
    ends = [
        f"{one.name} falls to {fixed_text(100 * float(np.min(one.curve.strehl)), 1)} % at "
        f"{signed_text(float(one.curve.errors_hz[int(np.argmin(one.curve.strehl[0, 0]))]))} Hz"
        for one in report.stable
    ]
    worst = 100 * min(float(np.min(one.curve.strehl)) for one in report.stable)
    return Chart(
        key="robustness",
        title="Strehl ratio over the frequency error",
        caption="Exact long-exposure Strehl ratio with every true vibration moved below the "
        "frequency that the design believes by the error, its rms kept, at the real sensor gain of "
        f"{number_text(report.real_gain)}.",
        alt=f"One curve a design. {listing_text(ends)}.",
        panels=(
            Panel(
                x=_ERROR,
                y=Axis(label=_STREHL, unit="%", low=max(0.0, 10 * np.floor((worst - 5) / 10))),
                marks=tuple(
                    _curve(
                        report,
                        one,
                        one.curve.errors_hz,
                        100 * one.curve.strehl[0, 0] if one.stable else None,
                    )
                    for one in report.assessments
                ),
                height_in=2.5,
            ),
        ),
    )


def _residuals(report: DesignReport) -> Chart:
    study = report.limits
    marks: list[Curve | Rule] = []
    if study.limit is not None and study.limit.rms_nm > 0:
        marks.append(Rule(name="limit, frequency known", at=study.limit.rms_nm, axis="y", dash=3))
    if study.band is not None:
        marks.append(
            Rule(
                name="limit, frequency anywhere in this range",
                at=study.band.rms_nm,
                axis="y",
                dash=1,
            )
        )
    for one, curve in zip(report.assessments, study.residual_nm, strict=True):
        values = curve[::-1] if one.stable else None
        marks.append(_curve(report, one, -study.shift_hz[::-1] + 0.0, values))
    limits = [
        f"{rule.name} {fixed_text(rule.at, 1)} nm" for rule in marks if isinstance(rule, Rule)
    ]
    worst = [f"{row.design} {fixed_text(row.worst_nm, 1)} nm" for row in study.rows if row.stable]
    return Chart(
        key="limits",
        title="Residual over the frequency error, beside the limits",
        caption="Exact residual. The lines are what no linear controller goes below: one that is "
        "told the frequency, and one that has to serve the whole range. Where a limit cannot be "
        "computed it is not drawn.",
        alt=f"One curve a design. Worst residuals: {listing_text(worst)}."
        + (f" Limits: {listing_text(limits)}." if limits else ""),
        panels=(
            Panel(
                x=_ERROR,
                y=Axis(label="residual", unit="nm rms", log=True),
                marks=tuple(marks),
                height_in=2.5,
            ),
        ),
    )


def _maps(report: DesignReport) -> list[Chart]:
    values = 100 * np.concatenate([one.map.strehl.ravel() for one in report.assessments])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 100.0)
    if high - low < 1:
        low, high = low - 0.5, high + 0.5
    panels = []
    for one in report.assessments:
        found = Map(
            x=one.map.errors_hz,
            y=one.map.sensor_gains,
            values=100 * one.map.strehl[0],
            label=_STREHL,
            unit="%",
            low=low,
            high=high,
            levels=_LEVELS,
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
    words = [_map_words(one) for one in report.assessments]
    return list(
        _in_sheets(
            Chart(
                key="map",
                title="Strehl ratio over frequency error and sensor gain",
                caption="One scale of colours for all designs; lines at round values. Sensor gains "
                "are relative to the sensor matrix of the configuration. Hatched: the loop is "
                "unstable there.",
                alt=f"One map a design. {' '.join(words)}",
                panels=tuple(panels),
                columns=_columns(len(panels)),
            )
        )
    )


def _map_words(one: DesignAssessment) -> str:
    values = one.map.strehl[np.isfinite(one.map.strehl)]
    if not values.size:
        return f"{one.name}: unstable everywhere."
    return (
        f"{one.name}: {fixed_text(100 * float(values.min()), 1)} to "
        f"{fixed_text(100 * float(values.max()), 1)} %, stable at {int(one.map.stable.sum())} of "
        f"{one.map.stable.size} sensor gains."
    )


def _over_gain(report: DesignReport) -> Chart:
    """Strehl ratio over the sensor gain, for a truth without vibrations."""
    words = [_map_words(one) for one in report.assessments]
    return Chart(
        key="sensor-gain",
        title="Strehl ratio over the sensor gain",
        caption="Exact long-exposure Strehl ratio. Sensor gains are relative to the sensor matrix "
        "of the configuration. Curves end where the loop becomes unstable.",
        alt=f"One curve a design. {' '.join(words)}",
        panels=(
            Panel(
                x=Axis(label="sensor gain", unit="-"),
                y=Axis(label=_STREHL, unit="%", low=0.0),
                marks=(
                    Rule(name="real sensor gain", at=report.real_gain, dash=3),
                    *(
                        _curve(report, one, one.map.sensor_gains, 100 * one.map.strehl[0, :, 0])
                        for one in report.assessments
                    ),
                ),
                height_in=2.5,
            ),
        ),
    )


def dynamics_charts(report: DesignReport) -> list[Chart]:
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
        _in_sheets(
            Chart(
                key="poles",
                title="Poles",
                caption="Poles of the closed loop (crosses) at the real sensor gain and of the "
                "controller by itself (circles). The loop is stable if all crosses lie inside the "
                "unit circle; near 1 they are slow, near the circle lightly damped.",
                alt="One complex plane a design, with the unit circle. Largest modulus of the "
                f"closed loop's poles: {listing_text(radii)}.",
                panels=tuple(panels),
                columns=_columns(len(panels)),
            )
        )
    )
    if report.stable:
        charts.append(_steps(report))
    return charts


def _steps(report: DesignReport) -> Chart:
    time = Axis(label="time after the step", unit="ms")
    rows = [(one, report.simulations[one.name]) for one in report.stable]
    peaks = [
        f"{one.name} {fixed_text(float(np.max(np.abs(run.step_residual_nm[5:]))), 0)} nm"
        for one, run in rows
    ]
    residuals = [
        _curve(report, one, 1e3 * run.step_time_s, run.step_residual_nm, step=True)
        for one, run in rows
    ]
    commands = [
        _curve(report, one, 1e3 * run.step_time_s, run.step_command_nm, step=True)
        for one, run in rows
    ]
    return Chart(
        key="step",
        title="Answer to a step",
        caption=f"The disturbance of the first axis steps by {STEP_NM:g} nm; nothing else moves, "
        "and there is no noise. Residual (above) and command (below) in frames of "
        f"{number_text(1e3 / report.config.hardware.frame_rate_hz)} ms. A controller with a model "
        "of a vibration rings at its frequency.",
        alt="Two panels over time, one curve a design. Largest residual from the sixth frame on: "
        f"{listing_text(peaks)}.",
        panels=(
            Panel(x=time, y=Axis(label="residual", unit="nm"), marks=tuple(residuals)),
            Panel(x=time, y=Axis(label="command", unit="nm"), marks=tuple(commands)),
        ),
    )


def simulation_charts(report: DesignReport) -> list[Chart]:
    """Series and spectra of the simulated loops."""
    rows = [(one, report.simulations[one.name]) for one in report.stable]
    if not rows:
        return []
    duration = fixed_text(float(rows[0][1].time_s[-1]), 2)
    largest = 1.05 * max(float(np.max(np.abs(run.series_nm[:, 0]))) for _, run in rows)
    series = Chart(
        key="series",
        title="Simulated residual",
        caption=f"First {duration} s of the first run, first axis; the same turbulence, vibrations "
        "and noise for all designs.",
        alt="One panel a design, all of the same scale, over time. Residuals over all runs: "
        + listing_text([f"{one.name} {fixed_text(run.residual_nm, 1)} nm rms" for one, run in rows])
        + ".",
        panels=tuple(
            Panel(
                title=one.name,
                x=Axis(label="time", unit="s"),
                y=Axis(label="residual", unit="nm", low=-largest, high=largest),
                marks=(
                    Curve(
                        name="",
                        x=run.time_s,
                        y=run.series_nm[:, 0],
                        look=_look(report, one),
                        width=0.9,
                        dashed=False,
                    ),
                ),
                height_in=0.95,
            )
            for one, run in rows
        ),
    )
    panels = tuple(
        Panel(
            title=one.name,
            x=_FREQUENCY,
            y=Axis(label="power spectrum", unit="nm²/Hz", log=True),
            marks=(
                Curve(
                    name="before the correction",
                    x=run.frequency_hz,
                    y=run.open_nm2_hz,
                    look=None,
                    width=0.8,
                ),
                Curve(
                    name="residual, simulated",
                    x=run.frequency_hz,
                    y=run.residual_nm2_hz,
                    look=5,
                    width=1.6,
                    dashed=False,
                ),
                Curve(
                    name="residual, exact",
                    x=run.frequency_hz,
                    y=run.exact_nm2_hz,
                    look=1,
                    width=1.4,
                ),
            ),
            height_in=2.2,
        )
        for one, run in rows
    )
    spectra = Chart(
        key="spectra",
        title="Spectra, simulated and exact",
        caption="Welch's method over all runs, with a Hann window; sums over the axes. The exact "
        "spectrum is that of the transfer functions, a sinusoid as the same window shows it.",
        alt="One panel a design: the spectrum before the correction, and that of the residual "
        "twice, simulated and exact, which lie on each other.",
        panels=panels,
        columns=_columns(len(panels)),
    )
    return [*_in_sheets(series), *_in_sheets(spectra)]


def _columns(panels: int) -> int:
    """Panels side by side: three, but two and two of four."""
    return 2 if panels == 4 else min(panels, 3)


def _in_sheets(chart: Chart) -> Iterator[Chart]:
    """Charts with so many panels that each fits a sheet of paper."""
    parts = [chart.panels[i : i + _PANELS] for i in range(0, len(chart.panels), _PANELS)]
    for number, panels in enumerate(parts):
        more = number > 0
        yield Chart(
            key=f"{chart.key}-{number + 1}" if more else chart.key,
            title=f"{chart.title} (continued)" if more else chart.title,
            caption=chart.caption,
            alt=chart.alt,
            panels=panels,
            columns=chart.columns,
        )


def _vibrations(report: DesignReport) -> list[Rule]:
    lines = sorted({line.frequency_hz for line in report.config.truth.vibrations})  # type: ignore[union-attr]
    name = "true vibration" if len(lines) == 1 else "true vibrations"
    return [Rule(name=name, at=frequency, dash=3) for frequency in lines]


def _curve(
    report: DesignReport,
    one: DesignAssessment,
    x: FloatArray,
    y: FloatArray | None,
    *,
    step: bool = False,
) -> Curve:
    """Curve of a design in its own look; without values it is in the legend as unstable."""
    look = _look(report, one)
    if y is None:
        return Curve(name=f"{one.name}: unstable", x=np.zeros(0), y=np.zeros(0), look=look)
    return Curve(name=one.name, x=x, y=y, look=look, step=step)


def _look(report: DesignReport, one: DesignAssessment) -> int:
    return [other.name for other in report.assessments].index(one.name)


def _largest(report: DesignReport, name: str, words: str) -> str:
    parts = [
        f"{one.name} {number_text(float(np.max(getattr(one, name))), 3)}" for one in report.stable
    ]
    return f"{words}: {listing_text(parts)}."
