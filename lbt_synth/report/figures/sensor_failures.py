"""Figure of a run in which sensors fail: residual over time, and its size beside the exact one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lbt_synth.loop import Simulation
from lbt_synth.loop.fusion.simulation import Segment
from lbt_synth.report.charts.description import Axis, Curve, Panel, Span
from lbt_synth.report.charts.matplotlib_charts import Figure, draw_figure
from lbt_synth.report.figures.simulation import series_panel

_WINDOW_S = 0.1  # over which the size of the residual is averaged


def sensor_failure_figure(
    run: Simulation, segments: Sequence[Segment], exact_nm: Sequence[float], *, title: str = ""
) -> Figure:
    """Residual of a run in which sensors fail.

    Parameters
    ----------
    run : Simulation
        The run; the series is that of its first case, its size the mean over all.
    segments : sequence of Segment
        Times between failures and returns.
    exact_nm : sequence of float
        Exact stationary residual of each segment [nm rms]; nan where there is none.
    title : str, optional
        Title of the figure.

    Returns
    -------
    matplotlib.figure.Figure
        Series above, its size below.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> from lbt_synth.loop.fusion.simulation import Segment
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> run = lbt.simulate(
    ...     lbt.integrator(path, gain=0.5),
    ...     lbt.Truth(turbulence=None, noise_nm=5.0),
    ...     hardware=path,
    ...     frames=512,
    ... )
    >>> whole = Segment(start_s=0.0, end_s=0.64, missing=(), wrong={})
    >>> figure = lbt.report.figures.sensor_failure_figure(run, [whole], [3.5])
    >>> len(figure.axes)
    2
    """
    return draw_figure(sensor_failure_panels(run, segments, exact_nm), title=title)


def sensor_failure_panels(
    run: Simulation, segments: Sequence[Segment], exact_nm: Sequence[float]
) -> tuple[Panel, Panel]:
    """Return the panels of :func:`sensor_failure_figure`."""
    _, frames, n = run.residual_nm.shape
    time, names = np.arange(frames) / run.frame_rate_hz, ("tip", "tilt")
    window = max(int(_WINDOW_S * run.frame_rate_hz), 1)
    whole = frames // window * window
    power = np.mean(np.sum(run.residual_nm[:, :whole] ** 2, axis=2), axis=0)
    size = np.sqrt(power.reshape(-1, window).mean(axis=1))
    centres = time[:whole].reshape(-1, window).mean(axis=1)
    failed = [segment for segment in segments if segment.text]
    looks = {text: 3 + i for i, text in enumerate(dict.fromkeys(s.text for s in failed))}
    spans = [Span(name=s.text, low=s.start_s, high=s.end_s, look=looks[s.text]) for s in failed]
    series = [
        Curve(
            name=names[i],
            x=time,
            y=run.residual_nm[0, :, i],
            look=i,
            width=0.5,
            opacity=0.7,
            dash=0,
        )
        for i in range(n)
    ]
    steps = [
        Curve(
            name="exact" if i == 0 else "",
            x=np.array([segment.start_s, segment.end_s]),
            y=np.array([exact, exact]),
            look=2,
            dash=2,
        )
        for i, (segment, exact) in enumerate(zip(segments, exact_nm, strict=True))
        if np.isfinite(exact)
    ]
    seen = Curve(name=f"in the run, over {_WINDOW_S:g} s", x=centres, y=size, look=0)
    x, y = Axis(label="time", unit="s"), Axis(label="residual, both axes", unit="nm rms", log=True)
    above = series_panel(series)
    above = replace(above, marks=(*spans, *above.marks))
    return above, Panel(x=x, y=y, marks=(*spans, seen, *steps))
