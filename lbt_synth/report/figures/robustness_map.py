"""Figure of Strehl ratios over frequency error and sensor gain."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.report.charts.description import Axis, Map, Panel, Rule
from lbt_synth.report.charts.map_cells import STREHL_LEVELS, strehl_scale
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.charts.scales import count_columns
from lbt_synth.report.figures.robustness import FREQUENCY_ERROR
from lbt_synth.studies import RobustnessMap


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
        One column of panels per design, one row per delay error, one colour bar for all. Sensor
        gains at which the loop is unstable are hatched.

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
    x = FREQUENCY_ERROR if len(maps) in (1, 2, 4) else Axis(label="frequency error", unit="Hz")
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
            y = Axis(label="sensor gain", unit="-")
            panels.append(Panel(title=f"{name}{late}", x=x, y=y, marks=tuple(marks), height_in=2.3))
    return tuple(panels)
