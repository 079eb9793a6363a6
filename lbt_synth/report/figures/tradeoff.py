"""Figure of the trade-off between variance, norm and tolerated sensor gain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.report.charts.description import Area, Axis, Curve, Mark, Panel, Rule, Span
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.studies import TradeoffPoint
from lbt_synth.studies.tradeoff import FAMILIES

_NAMES = dict(
    zip(FAMILIES, ("least variance at this norm", "central H∞ filter of this norm"), strict=True)
)


def tradeoff_figure(points: Sequence[TradeoffPoint], *, axes: OwnAxes = None) -> Figure:
    """Draw deviation and stable sensor gains over the norm of the estimation error.

    Parameters
    ----------
    points : sequence of TradeoffPoint
        Points of :func:`tradeoff`.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Above, the standard deviation; below, if there are loops, the interval of sensor
        gains for which each is stable. Norms that no filter reaches are shaded.

    Raises
    ------
    ProblemError
        If there are no points,
        or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> points = list(lbt.studies.tradeoff(walk, points=2, families=["central"]))
    >>> len(lbt.report.figures.tradeoff_figure(points).axes)
    1
    """
    if not points:
        raise ProblemError("a trade-off figure needs at least one point; got none.")
    loops = any(point.design.hardware is not None for point in points)
    unit = "nm" if loops else "-"
    norms = [point.gamma for point in points]
    margin = 0.06 * (max(norms) - min(norms)) or 0.01 * max(norms)
    low, high = min(norms) - margin, max(norms) + margin
    x = Axis(label="H∞ norm of the estimation error", unit=unit, low=low, high=high)
    unreached = Span(name="no filter", low=low, high=min(norms))
    errors: list[Mark] = []
    gains: list[Mark] = []
    for look, family in enumerate(dict.fromkeys(point.family for point in points)):
        own = sorted((p for p in points if p.family == family), key=lambda p: p.gamma)
        gamma = np.array([p.gamma for p in own])
        style: dict[str, Any] = {"x": gamma, "look": look, "marker": "own", "size": 4.0}
        name = _NAMES.get(family, family)
        errors.append(Curve(name=name, y=np.array([p.rms for p in own]), **style))
        # an open end is drawn at the border of what is shown
        least = np.array([max(p.gain_low, 1e-2) for p in own])
        most = np.array([min(p.gain_high, 1e2) for p in own])
        gains.append(Area(name="", x=gamma, low=least, high=most, look=look))
        gains += [Curve(name=name, y=ends, **style) for ends in (least, most)]
    kalman: dict[str, Any] = {"line": False, "marker": "circle", "filled": False, "size": 9.0}
    least_rms = np.array([min(p.rms for p in points)])
    errors.append(Curve(name="Kalman", x=np.array([max(norms)]), y=least_rms, look=None, **kalman))
    y = Axis(label="estimation error, rms", unit=unit)
    panels = [Panel(x=x, y=y, marks=(*errors, unreached), height_in=2.3)]
    if loops:
        gains.append(Rule(name="nominal sensor gain", at=1.0, axis="y", dash=1))
        y = Axis(label="sensor gains with a stable loop", unit="-", log=True)
        panels.append(Panel(x=x, y=y, marks=(*gains, unreached), height_in=2.3))
    return draw_figure(panels, axes=axes)
