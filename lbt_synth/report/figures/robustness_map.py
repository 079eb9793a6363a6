"""Figure of Strehl ratios over frequency error and sensor gain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.report.figures.style import house_style, new_figure
from lbt_synth.report.map_cells import (
    STREHL_LEVELS,
    cell_edges,
    draw_cells,
    marked_intervals,
    strehl_scale,
)
from lbt_synth.studies import RobustnessMap


def robustness_map_figure(maps: Mapping[str, RobustnessMap]) -> Any:
    """Draw the Strehl ratio of designs over frequency error and sensor gain.

    Parameters
    ----------
    maps : mapping of str to RobustnessMap
        Maps of :func:`robustness_map` by the names of their designs.

    Returns
    -------
    matplotlib.figure.Figure
        One column of panels per design, one row per delay error, one colour bar for all. Sensor
        gains at which the loop is unstable are hatched.

    Raises
    ------
    ProblemError
        If there is no map, or the maps have different delay errors.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> found = lbt.studies.robustness_map(
    ...     lbt.integrator(path, gain=0.5),
    ...     lbt.Truth(turbulence=None),
    ...     lbt.Imaging(diameter_m=8.22),
    ...     errors_hz=[0],
    ...     sensor_gains=[1, 3],
    ... )
    >>> len(
    ...     lbt.report.figures.robustness_map_figure({"integrator": found}).axes
    ... )  # one panel and the colour bar
    2
    """
    if not maps:
        raise ProblemError("a map figure needs at least one map; got none.")
    delays = next(iter(maps.values())).delay_errors_frames
    for name, found in maps.items():
        if not np.array_equal(found.delay_errors_frames, delays):
            raise ProblemError(
                f"the maps must have the same delay errors {delays.tolist()}; got "
                f"{found.delay_errors_frames.tolist()} for {name}."
            )
    low, high = strehl_scale([found.strehl for found in maps.values()])
    with house_style():
        columns, rows = len(maps), len(delays)
        figure = new_figure(max(4.4, 1.3 + 2.6 * columns), 0.7 + 2.5 * rows)
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for column, (name, found) in enumerate(maps.items()):
            for row, panel in enumerate(panels[:, column]):
                mesh = _draw_panel(panel, found, row, low, high)
                panel.label_outer()
            panels[0, column].set_title(name)
        for row, delay in enumerate(delays):
            late = f"delay error {delay:+g} frames\n" if rows > 1 or delay != 0 else ""
            panels[row, 0].set_ylabel(f"{late}sensor gain [-]")
        figure.supxlabel("frequency in the design less the true one [Hz]", fontsize=9)
        bar = figure.colorbar(mesh, ax=panels, pad=0.02, fraction=0.06, aspect=22 * rows)
        bar.set_label("Strehl ratio [%]")
        bar.outline.set_visible(False)
    return figure


def _draw_panel(panel: Any, found: RobustnessMap, row: int, low: float, high: float) -> Any:
    across, up = np.argsort(found.errors_hz), np.argsort(found.sensor_gains)
    errors, gains = found.errors_hz[across], found.sensor_gains[up]
    percent = 100 * found.strehl[row][np.ix_(up, across)]
    mesh = draw_cells(panel, errors, gains, percent, low=low, high=high, levels=STREHL_LEVELS)
    x, y = cell_edges(errors), cell_edges(gains)
    height = y[-1] - y[0]
    for bottom, top in marked_intervals(~found.stable[row][up], y):
        panel.axhspan(bottom, top, facecolor="0.85", edgecolor="0.55", hatch="////", linewidth=0)
        if top - bottom < 0.08 * height:  # no room for a word
            continue
        panel.text(
            (x[0] + x[-1]) / 2,
            np.clip((bottom + top) / 2, y[0] + 0.05 * height, y[-1] - 0.05 * height),
            "unstable",
            ha="center",
            va="center",
            fontsize=8,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        )
    panel.set_xlim(x[0], x[-1])
    panel.set_ylim(y[0], y[-1])
    return mesh
