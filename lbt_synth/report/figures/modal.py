"""Figure of modal control: gains and residuals over the modes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.report.charts.description import Axis, Curve, Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.validation import FloatArray, real_array


def modal_figure(
    residuals_nm: Mapping[str, ArrayLike],
    *,
    gains: ArrayLike | None = None,
    turbulence_nm: ArrayLike | None = None,
    axes: OwnAxes = None,
) -> Figure:
    """Draw the residual of each mode under several controllers, and integrator gains.

    Parameters
    ----------
    residuals_nm : mapping of str to (n,) array_like
        Residual of each mode [nm rms] by the names of the controllers.
    gains : (n,) array_like, optional
        Integrator gain of each mode, for a panel of its own.
    turbulence_nm : (n,) array_like, optional
        Turbulence of each mode [nm rms], before any correction.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel over the other with a common axis of modes, counted from 1.

    Raises
    ------
    ProblemError
        If there is no controller, a value is not finite or not positive, or lengths differ,
        or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> len(lbt.report.figures.modal_figure({"integrator": [9.0, 5.0]}, gains=[0.5, 0.4]).axes)
    2
    """
    if not residuals_nm:
        raise ProblemError("a modal figure needs the residuals of a controller; got none.")
    given = {"turbulence_nm": turbulence_nm, "gains": gains}
    curves = {
        name: _require_modes(values, name)
        for name, values in (*residuals_nm.items(), *given.items())
        if values is not None
    }
    count = curves[next(iter(residuals_nm))].size
    for name, values in curves.items():
        if values.size != count:
            raise DimensionError(
                f"{name} must have {count} modes like the others; got {values.size}."
            )
    modes = np.arange(1.0, count + 1)
    x = Axis(label="mode, in Noll's order from tip on", log=True, low=1, high=max(count, 2))
    panels = []
    if gains is not None:
        look = len(residuals_nm)  # of none of the residuals, nor of the turbulence
        above = Curve(name="", x=modes, y=curves["gains"], look=look, dash=0, step="center")
        y = Axis(label="integrator gain", low=0)
        panels.append(Panel(x=x, y=y, marks=(above,), height_in=1.7))
    # modes are counted, there is nothing between them
    marks = [
        Curve(name=name, x=modes, y=curves[name], look=look, step="center")
        for look, name in enumerate(residuals_nm)
    ]
    if turbulence_nm is not None:
        y_turbulence = curves["turbulence_nm"]
        marks.insert(
            0,
            Curve(name="turbulence", x=modes, y=y_turbulence, look=None, width=1.0, step="center"),
        )
    y = Axis(label="residual", unit="nm rms", log=True)
    panels.append(Panel(x=x, y=y, marks=tuple(marks), height_in=2.6))
    return draw_figure(panels, axes=axes)


def _require_modes(values: ArrayLike, name: str) -> FloatArray:
    """Return a positive number per mode, (n,)."""
    curve = real_array(values, name)
    if curve.ndim != 1 or curve.size == 0:
        raise DimensionError(
            f"{name} must be a list, one number per mode; got shape {curve.shape}."
        )
    if np.any(curve <= 0):
        raise ProblemError(f"{name} must be above 0; got {curve.min():.6g}.")
    return curve
