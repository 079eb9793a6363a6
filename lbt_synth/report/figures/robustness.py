"""Figures of the Strehl ratio over frequency error, and over sensor gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.methods.registry import design_label
from lbt_synth.report.charts.description import Axis, Curve, Map, Panel, Rule
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.charts.scales import STREHL_LEVELS, count_columns, strehl_scale
from lbt_synth.studies import RobustnessMap, RobustnessRow

FREQUENCY_ERROR = Axis(label="frequency error, truth less design", unit="Hz")
SHORT_FREQUENCY_ERROR = Axis(label="frequency error", unit="Hz")  # of narrow panels


def robustness_figure(
    rows: Sequence[RobustnessRow],
    published: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    *,
    axes: OwnAxes = None,
) -> Figure:
    """Strehl ratio over the error of the model's vibration frequency.

    Parameters
    ----------
    rows : sequence of RobustnessRow
        Rows of :func:`lbt_synth.studies.robustness`.
    published : mapping, optional
        For each method, pairs (error [Hz], Strehl ratio [%]) drawn as open markers.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel; unstable rows are left out of the line and marked at the bottom.

    Raises
    ------
    ProblemError
        If there are no rows,
        or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> row = lbt.studies.RobustnessRow(
    ...     error_hz=0.0,
    ...     method="kalman",
    ...     strehl=0.8,
    ...     residual_nm=40.0,
    ...     vibration_nm=10.0,
    ...     turbulence_nm=20.0,
    ...     noise_nm=30.0,
    ...     stable=True,
    ...     gamma=190.0,
    ... )
    >>> len(lbt.report.figures.robustness_figure([row]).axes)
    1
    """
    if not rows:
        raise ProblemError("a robustness figure needs at least one row; got none.")
    curves = []
    for look, method in enumerate(dict.fromkeys(row.method for row in rows)):
        own = sorted((r for r in rows if r.method == method), key=lambda r: r.error_hz)
        label = design_label(method)
        stable = [r for r in own if r.stable]
        unstable = np.array([r.error_hz for r in own if not r.stable])
        if stable:
            x = np.array([r.error_hz for r in own])
            y = np.array([100 * r.strehl if r.stable else np.nan for r in own])
            curves.append(Curve(name=label, x=x, y=y, look=look, marker="own", size=4.0))
        if unstable.size:
            name, zero = f"{label}: unstable", np.zeros(unstable.size)
            curves.append(
                Curve(name=name, x=unstable, y=zero, look=look, line=False, marker="cross")
            )
        if published is not None and method in published:
            x, y = np.array(published[method], dtype=float).T
            style: dict[str, Any] = {"line": False, "marker": "own", "filled": False, "size": 7.0}
            curves.append(Curve(name=f"{label}, paper", x=x, y=y, look=look, **style))
    return draw_figure([strehl_panel(curves)], axes=axes)


def strehl_panel(curves: Sequence[Curve]) -> Panel:
    """Return curves of the Strehl ratio over the frequency error, on a scale that they fill."""
    return Panel(x=FREQUENCY_ERROR, y=strehl_axis(curves), marks=tuple(curves), height_in=2.5)


def strehl_axis(curves: Sequence[Curve]) -> Axis:
    """Return the axis of Strehl ratios, from a multiple of 10 % or 1 % below the least on."""
    values = np.concatenate([curve.y for curve in curves] or [np.zeros(0)])
    values = values[np.isfinite(values)]
    least, most = (values.min(), values.max()) if values.size else (0.0, 100.0)
    step = 10.0 if most - least > 10 else 1.0  # of the lower end
    low = max(0.0, step * np.floor(least / step - 0.5))
    return Axis(label="Strehl ratio", unit="%", low=low)


def robustness_map_figure(maps: Mapping[str, RobustnessMap], *, axes: OwnAxes = None) -> Figure:
    """Draw the Strehl ratio of designs over frequency error and sensor gain.

    Parameters
    ----------
    maps : mapping of str to RobustnessMap
        Maps of :func:`robustness_map` by the names of their designs.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel per delay error and design, up to three side by side, with one colour bar for
        all. Sensor gains at which the loop is unstable are hatched.

    Raises
    ------
    ProblemError
        If there is no map, or the maps have different delay errors,
        or ``axes`` are not one per panel.

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
    columns = min(len(maps), 3) if len(delays) > 1 else count_columns(len(maps))
    return draw_figure(map_panels(maps), columns=columns, axes=axes)


def map_panels(
    maps: Mapping[str, RobustnessMap], *, real_gain: float | None = None
) -> tuple[Panel, ...]:
    """Return a map per delay error and design on one scale of colours."""
    low, high = strehl_scale([found.strehl for found in maps.values()])
    delays = next(iter(maps.values())).delay_errors_frames
    # the long name of the axis does not fit three columns
    x = FREQUENCY_ERROR if len(maps) in (1, 2, 4) else SHORT_FREQUENCY_ERROR
    panels = []
    for row, delay in enumerate(delays):
        late = f", delay error {delay:+g} frames" if len(delays) > 1 or delay != 0 else ""
        for name, found in maps.items():
            across, up = np.argsort(found.errors_hz), np.argsort(found.sensor_gains)
            gains = found.sensor_gains[up]
            marks: list[Map | Rule] = [
                Map(
                    x=found.errors_hz[across],
                    y=gains,
                    values=100 * found.strehl[row][np.ix_(up, across)],
                    label="Strehl ratio",
                    unit="%",
                    low=low,
                    high=high,
                    levels=STREHL_LEVELS,
                    blank="unstable loop",
                )
            ]
            if real_gain is not None and gains[0] <= real_gain <= gains[-1]:
                marks.append(Rule(name="real sensor gain", at=real_gain, axis="y", dash=1))
            marks += [
                Rule(name="edge of the design's band", at=edge, dash=2)
                for edge in found.band_hz or ()
                if found.errors_hz.min() < edge < found.errors_hz.max()
            ]
            y = Axis(label="sensor gain", unit="-")
            panels.append(Panel(title=f"{name}{late}", x=x, y=y, marks=tuple(marks), height_in=2.3))
    return tuple(panels)
