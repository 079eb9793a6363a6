"""Figure of modal control: gains and residuals over the modes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.report.figures.style import house_style, new_figure, number_ticks
from lbt_synth.report.line_styles import line_styles
from lbt_synth.validation import FloatArray, real_array

_STEPS = "steps-mid"  # modes are counted, there is nothing between them


def modal_figure(
    residuals_nm: Mapping[str, Any], *, gains: Any = None, turbulence_nm: Any = None
) -> Any:
    """Draw the residual of each mode under several controllers, and integrator gains.

    Parameters
    ----------
    residuals_nm : mapping of str to (n,) array_like
        Residual of each mode [nm rms] by the names of the controllers.
    gains : (n,) array_like, optional
        Integrator gain of each mode, for a panel of its own.
    turbulence_nm : (n,) array_like, optional
        Turbulence of each mode [nm rms], before any correction.

    Returns
    -------
    matplotlib.figure.Figure
        One panel over the other with a common axis of modes, counted from 1.

    Raises
    ------
    ProblemError
        If there is no controller, a value is not finite or not positive, or lengths differ.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> len(lbt.report.figures.modal_figure({"integrator": [9.0, 5.0]}, gains=[0.5, 0.4]).axes)
    2
    """
    from matplotlib.ticker import FuncFormatter

    if not residuals_nm:
        raise ProblemError("a modal figure needs the residuals of a controller; got none.")
    curves = {name: _check_curve(values, name) for name, values in residuals_nm.items()}
    count = len(next(iter(curves.values())))
    others = {
        name: _check_curve(values, name)
        for name, values in (("gains", gains), ("turbulence_nm", turbulence_nm))
        if values is not None
    }
    for name, values in (curves | others).items():
        if values.size != count:
            raise DimensionError(
                f"{name} must have {count} modes like the others; got {values.size}."
            )
    modes = np.arange(1, count + 1)
    with house_style():
        figure = new_figure(6.3, 5.2 if gains is not None else 3.6)
        if gains is not None:
            above, axis = figure.subplots(2, 1, sharex=True, height_ratios=(2, 3))
            above.plot(modes, others["gains"], color="0.25", linewidth=1.2, drawstyle=_STEPS)
            above.set_ylabel("integrator gain")
            above.set_ylim(bottom=0)
        else:
            axis = figure.subplots()
        if turbulence_nm is not None:
            axis.plot(
                modes,
                others["turbulence_nm"],
                color="0.6",
                linewidth=1.2,
                drawstyle=_STEPS,
                label="turbulence",
            )
        for (name, values), style in zip(curves.items(), line_styles(), strict=False):
            axis.plot(modes, values, label=name, drawstyle=_STEPS, **style)
        axis.set_xscale("log")
        axis.set_yscale("log")
        number_ticks(axis.yaxis)
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_xlim(1, max(count, 2))
        axis.set(xlabel="mode, in Noll's order from tip on", ylabel="residual [nm rms]")
        figure.legend(loc="outside upper center", ncols=min(4, len(curves) + 1))
    return figure


def _check_curve(values: Any, name: str) -> FloatArray:
    curve = real_array(values, name)
    if curve.ndim != 1 or curve.size == 0:
        raise DimensionError(f"{name} must be a list, one number a mode; got shape {curve.shape}.")
    if np.any(curve <= 0):
        raise ProblemError(f"{name} must be above 0; got {curve.min():.6g}.")
    return curve
