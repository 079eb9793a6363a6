"""Figure of the trade-off between variance, norm and tolerated sensor gain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.report.figures.style import house_style, new_figure, number_ticks
from lbt_synth.report.line_styles import MARKERS, line_styles
from lbt_synth.studies import TradeoffPoint

_NAMES = {
    "mixed": "least variance at this norm",
    "central": r"central H$_\infty$ filter of this norm",
}


def tradeoff_figure(points: Sequence[TradeoffPoint]) -> Any:
    """Draw deviation and stable sensor gains over the norm of the estimation error.

    Parameters
    ----------
    points : sequence of TradeoffPoint
        Points of :func:`tradeoff`.

    Returns
    -------
    matplotlib.figure.Figure
        Above, the standard deviation; below, if there are loops, the interval of sensor
        gains for which each is stable. Norms that no filter reaches are hatched.

    Raises
    ------
    ProblemError
        If there are no points.

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
    families = list(dict.fromkeys(point.family for point in points))
    norms = [point.gamma for point in points]
    margin = 0.06 * (max(norms) - min(norms)) or 0.01 * max(norms)
    with house_style():
        figure = new_figure(6.3, 5.4 if loops else 3.2)
        axes = list(np.atleast_1d(figure.subplots(1 + loops, 1, sharex=True)))
        for family, style, marker in zip(families, line_styles(), MARKERS, strict=False):
            own = sorted((p for p in points if p.family == family), key=lambda p: p.gamma)
            gamma = [p.gamma for p in own]
            label = _NAMES.get(family, family)
            axes[0].plot(
                gamma, [p.rms for p in own], marker=marker, markersize=4, label=label, **style
            )
            if loops:
                _draw_stable_gains(axes[1], own, marker, label, style)
        axes[0].set_ylabel(f"estimation error, rms [{unit}]")
        for axis in axes:
            axis.axvspan(
                min(norms) - margin,
                min(norms),
                facecolor="0.9",
                edgecolor="0.6",
                hatch="///",
                linewidth=0,
                label="no filter" if axis is axes[0] else None,
                zorder=0,
            )
            axis.set_xlim(min(norms) - margin, max(norms) + margin)
        axes[0].annotate(
            "Kalman",
            (max(norms), min(p.rms for p in points)),
            xytext=(-6, 12),
            textcoords="offset points",
            ha="right",
            fontsize=8,
        )
        axes[0].legend(loc="best")
        axes[-1].set_xlabel(rf"H$_\infty$ norm of the estimation error [{unit}]")
        if loops:
            axes[1].set_yscale("log")
            axes[1].axhline(1, color="0.4", linewidth=0.8)
            axes[1].set_ylabel("sensor gains with a stable loop [-]")
            axes[1].text(
                0.99,
                1,
                "nominal ",
                transform=axes[1].get_yaxis_transform(),
                ha="right",
                va="bottom",
                fontsize=8,
                color="0.3",
            )
            number_ticks(axes[1].yaxis)
    return figure


def _draw_stable_gains(
    axis: Any, own: Sequence[TradeoffPoint], marker: str, label: str, style: dict[str, Any]
) -> None:
    gamma = [p.gamma for p in own]
    # an open end is drawn at the border of what is shown
    low = [max(p.gain_low, 1e-2) for p in own]
    high = [min(p.gain_high, 1e2) for p in own]
    axis.fill_between(gamma, low, high, color=style["color"], alpha=0.12, linewidth=0)
    axis.plot(gamma, low, marker=marker, markersize=4, label=label, **style)
    axis.plot(gamma, high, marker=marker, markersize=4, **style)
