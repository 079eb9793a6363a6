"""Charts of simulated loops: residuals over time, and spectra."""

from __future__ import annotations

import numpy as np

from lbt_synth.report.designs.design_curves import (
    FREQUENCY,
    count_columns,
    look_number,
    split_by_sheets,
)
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.designs.simulation import DesignSimulation
from lbt_synth.report.number_text import fixed_text, listing_text
from lbt_synth.report.page.charts import Axis, Chart, Curve, Panel


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
        alt="One panel per design, all of the same scale, over time. Residuals over all runs: "
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
                        look=look_number(report, one),
                        width=0.9,
                        dashed=False,
                    ),
                ),
                height_in=0.95,
            )
            for one, run in rows
        ),
    )
    panels = tuple(_spectra_panel(one.name, run) for one, run in rows)
    spectra = Chart(
        key="spectra",
        title="Spectra, simulated and exact",
        caption="Welch's method over all runs, with a Hann window; sums over the axes. The exact "
        "spectrum is that of the transfer functions, a sinusoid as the same window shows it.",
        alt="One panel per design: the spectrum before the correction, and that of the residual "
        "twice, simulated and exact, which lie on each other.",
        panels=panels,
        columns=count_columns(len(panels)),
    )
    return [*split_by_sheets(series), *split_by_sheets(spectra)]


def _spectra_panel(name: str, run: DesignSimulation) -> Panel:
    f = run.frequency_hz
    exact = Curve(name="residual, exact", x=f, y=run.exact_nm2_hz, look=1, width=1.4)
    before = Curve(name="before the correction", x=f, y=run.open_nm2_hz, look=None, width=0.8)
    simulated = Curve(name="residual, simulated", x=f, y=run.residual_nm2_hz, look=5, dashed=False)
    return Panel(
        title=name,
        x=FREQUENCY,
        y=Axis(label="power spectrum", unit="nm²/Hz", log=True),
        marks=(before, simulated, exact),
        height_in=2.2,
    )
