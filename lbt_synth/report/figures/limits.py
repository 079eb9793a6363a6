"""Figure of designs beside the limits of performance."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.report.figures.style import METHOD_LABELS, house_style, new_figure, number_ticks
from lbt_synth.report.line_styles import line_styles
from lbt_synth.studies import LimitStudy


def limits_figure(study: LimitStudy) -> Any:
    """Draw the residual of each design over the vibration's frequency, and the limits.

    Parameters
    ----------
    study : LimitStudy
        Result of :func:`limits`, of a truth with a vibration and a range of errors.

    Returns
    -------
    matplotlib.figure.Figure
        One panel with a logarithmic residual; unstable designs are named and not drawn.

    Raises
    ------
    ProblemError
        If no vibration moves.

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
    x = study.shift_hz + (study.frequency_hz or 0.0)
    with house_style():
        figure = new_figure(6.3, 3.8)
        axis = figure.subplots()
        for row, curve, style in zip(study.rows, study.residual_nm, line_styles(), strict=False):
            label = METHOD_LABELS.get(row.design, row.design)
            if row.stable:
                axis.plot(x, curve, label=label, **style)
            else:
                axis.plot([], [], label=f"{label}: unstable", **style)
        lines: dict[str, Any] = {"color": "0.25", "linewidth": 1.2, "zorder": 1.5}
        if study.band is not None:
            label = "limit, frequency anywhere in this range"
            axis.axhline(study.band.rms_nm, linestyle=(0, (7, 2)), label=label, **lines)
        if study.limit is not None and study.limit.rms_nm > 0:
            label = "limit, frequency known"
            axis.axhline(study.limit.rms_nm, linestyle=(0, (1, 1.5)), label=label, **lines)
        axis.set_yscale("log")
        number_ticks(axis.yaxis)
        axis.set_xlim(float(x[0]), float(x[-1]))
        low, high = axis.get_ylim()
        drawn = study.residual_nm[np.isfinite(study.residual_nm)]
        top = float(np.max(drawn)) if drawn.size else high
        axis.set_ylim(low, top * (top / low) ** 0.05)
        word = "frequency of the true vibration" if single else "shift of the true vibrations"
        axis.set(xlabel=f"{word} [Hz]", ylabel="residual [nm rms]")
        figure.legend(loc="outside upper center", ncols=3)
    return figure
