"""Figure of the Strehl ratio over the error of the vibration frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.methods.registry import design_label
from lbt_synth.report.charts.description import Axis, Curve, Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.studies import RobustnessRow

FREQUENCY_ERROR = Axis(label="frequency error, design less truth", unit="Hz")


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


def strehl_panel(curves: Sequence[Curve], low: float = 0.0) -> Panel:
    """Return curves of the Strehl ratio over the frequency error."""
    y = Axis(label="Strehl ratio", unit="%", low=low)
    return Panel(x=FREQUENCY_ERROR, y=y, marks=tuple(curves), height_in=2.5)
