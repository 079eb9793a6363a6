"""Figure of designs with the limits of performance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.methods.registry import design_label
from lbt_synth.report.charts.description import Axis, Curve, Panel, Rule
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.figures.loop import stable_curve
from lbt_synth.studies import LimitStudy
from lbt_synth.validation import FloatArray


def limits_figure(study: LimitStudy, *, axes: OwnAxes = None) -> Figure:
    """Draw the residual of each design over the vibration's frequency, and the limits.

    Parameters
    ----------
    study : LimitStudy
        Result of :func:`limits`, of a truth with a vibration and a range of errors.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel with a logarithmic residual; unstable designs are named and not drawn.

    Raises
    ------
    ProblemError
        If no vibration moves,
        or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> line = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100, direction=(1,))
    >>> study = lbt.studies.limits(
    ...     {"by hand": lbt.integrator(path, gain=0.5)},
    ...     path,
    ...     lbt.Truth(turbulence=None, vibrations=(line,), noise_nm=5.0),
    ...     lbt.Imaging(diameter_m=8.22),
    ...     errors_hz=[-2, 2],
    ... )
    >>> len(lbt.report.figures.limits_figure(study).axes)
    1
    """
    if study.shift_hz.size < 2:
        raise ProblemError(
            "a figure of limits needs a vibration that moves; got a truth without vibrations, or "
            "a single error. Give truth.vibrations and robustness.errors_hz."
        )
    single = study.frequency_hz is not None
    word = "frequency of the true vibration" if single else "shift of the true vibrations"
    x = Axis(label=word, unit="Hz")
    shifted = study.shift_hz + (study.frequency_hz or 0.0)
    return draw_figure([limits_panel(study, x, shifted, design_label)], axes=axes)


def limits_panel(
    study: LimitStudy, x: Axis, places: FloatArray, label: Callable[[str], str]
) -> Panel:
    """Return the residual of each design, and the limits, over places on an axis."""
    names = [label(row.design) for row in study.rows]
    order = np.argsort(places)
    marks: list[Curve | Rule] = [
        stable_curve(name, names, places[order], curve[order] if row.stable else None)
        for name, row, curve in zip(names, study.rows, study.residual_nm, strict=True)
    ]
    if study.limit is not None and study.limit.rms_nm > 0:
        marks.append(Rule(name="limit, frequency known", at=study.limit.rms_nm, axis="y", dash=3))
    if study.band is not None:
        name = "limit, frequency anywhere in this range"
        marks.append(Rule(name=name, at=study.band.rms_nm, axis="y", dash=1))
    y = Axis(label="residual", unit="nm rms", log=True)
    return Panel(x=x, y=y, marks=tuple(marks), height_in=2.5)
