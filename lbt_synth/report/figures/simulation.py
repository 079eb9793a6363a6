"""Figure of a simulation: residual over time, and spectra with and without the correction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import welch

from lbt_synth.loop import Simulation
from lbt_synth.report.charts.description import Axis, Curve, Mark, Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.figures.loop import FREQUENCY

_SERIES_S = 1.0  # of a series, in which single oscillations are seen


def simulation_figure(run: Simulation, *, title: str = "", axes: OwnAxes = None) -> Figure:
    """Residual series and spectra before and after the correction.

    Parameters
    ----------
    run : Simulation
        A run; the first second of its first case is drawn, the spectra are means over all cases.
    title : str, optional
        Title of the figure.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Series above, spectra below.

    Raises
    ------
    ProblemError
        If ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> run = lbt.simulate(
    ...     lazy.controller, lbt.Truth(turbulence=None, noise_nm=5.0), hardware=path, frames=512
    ... )
    >>> len(lbt.report.figures.simulation_figure(run).axes)
    2
    """
    _, frames, n = run.residual_nm.shape
    names = ("tip", "tilt") if n <= 2 else [f"mode {i}" for i in range(1, n + 1)]
    shown = min(frames, int(np.ceil(_SERIES_S * run.frame_rate_hz)))
    time = np.arange(shown) / run.frame_rate_hz
    series, spectra = [], []
    for i in range(n):
        y = run.residual_nm[0, :shown, i]
        name = f"{names[i]}, residual"
        series.append(Curve(name=name, x=time, y=y, look=i, width=0.8, opacity=0.8, dash=0))
        # the residual is solid, what there was before it is dotted
        for data, word, dash in ((run.total_nm, "open loop", 3), (run.residual_nm, "residual", 0)):
            length = min(frames, 2048)
            f, s = welch(data[:, :, i], run.frame_rate_hz, nperseg=length)
            name, mean = f"{names[i]}, {word}", s.mean(axis=0)[1:]
            spectra.append(Curve(name=name, x=f[1:], y=mean, look=i, width=1.0, dash=dash))
    panels = (series_panel(series), spectra_panel(spectra))
    return draw_figure(panels, title=title, axes=axes)


def series_panel(
    curves: Sequence[Curve], *, title: str = "", reach: float | None = None, height_in: float = 2.1
) -> Panel:
    """Return residuals over time on a scale that reaches as far on both sides of 0."""
    low = None if reach is None else -reach
    y = Axis(label="residual", unit="nm", low=low, high=reach)
    x = Axis(label="time", unit="s")
    return Panel(x=x, y=y, marks=tuple(curves), title=title, height_in=height_in)


def spectra_panel(marks: Sequence[Mark], *, title: str = "") -> Panel:
    """Return power spectra over frequency."""
    y = Axis(label="power spectrum", unit="nm²/Hz", log=True)
    return Panel(x=FREQUENCY, y=y, marks=tuple(marks), title=title, height_in=2.2)
