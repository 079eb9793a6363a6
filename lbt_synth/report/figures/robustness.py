"""Figure of the Strehl ratio over the error of the vibration frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lbt_synth.errors import ProblemError
from lbt_synth.report.figures.style import METHOD_LABELS, house_style, new_figure
from lbt_synth.report.line_styles import MARKERS, line_styles
from lbt_synth.studies import RobustnessRow


def robustness_figure(
    rows: Sequence[RobustnessRow],
    published: Mapping[str, Sequence[tuple[float, float]]] | None = None,
) -> Any:
    """Strehl ratio over the error of the model's vibration frequency.

    Parameters
    ----------
    rows : sequence of RobustnessRow
        Rows of :func:`lbt_synth.studies.robustness`.
    published : mapping, optional
        For each method, pairs (error [Hz], Strehl ratio [%]) drawn as open markers.

    Returns
    -------
    matplotlib.figure.Figure
        One panel; unstable rows are left out of the line and marked at the bottom.

    Raises
    ------
    ProblemError
        If there are no rows.

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
    methods = list(dict.fromkeys(row.method for row in rows))
    with house_style():
        figure = new_figure(6.3, 3.8)
        axis = figure.subplots()
        for method, style, marker in zip(methods, line_styles(), MARKERS, strict=False):
            own = sorted((r for r in rows if r.method == method), key=lambda r: r.error_hz)
            label = METHOD_LABELS.get(method, method)
            axis.plot(
                [r.error_hz for r in own],
                [100 * r.strehl for r in own],
                marker=marker,
                markersize=4,
                label=label if any(r.stable for r in own) else None,
                **style,
            )
            unstable = [r.error_hz for r in own if not r.stable]
            if unstable:
                axis.plot(
                    unstable,
                    [0.0] * len(unstable),
                    linestyle="none",
                    marker="x",
                    clip_on=False,
                    color=style["color"],
                    label=f"{label}: unstable",
                )
            if published is not None and method in published:
                errors, values = zip(*published[method], strict=True)
                axis.plot(
                    errors,
                    values,
                    linestyle="none",
                    marker=marker,
                    markersize=7,
                    markerfacecolor="none",
                    markeredgecolor=style["color"],
                    label=f"{label}, paper",
                )
        axis.set(
            xlabel="error of the vibration frequency in the model [Hz]", ylabel="Strehl ratio [%]"
        )
        axis.set_ylim(0, 1.06 * axis.get_ylim()[1])
        axis.legend(loc="best")
    return figure
