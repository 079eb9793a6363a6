"""The figures of a run in time, and of one whose sensors fail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import welch

from lbt_synth.loop import Simulation
from lbt_synth.loop.simulation.failing_sensors import Segment
from lbt_synth.report.charts.description import Axis, Curve, Mark, Panel, Span
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.figures.loop import FREQUENCY

_SERIES_S = 1.0  # of a series, in which single oscillations are seen


def simulation_figure(run: Simulation, *, title: str = "", axes: OwnAxes = None) -> Figure:
    """Residual series and spectra before and after the correction.

    The first second of the first case is drawn; the spectra are means over all cases.
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


_WINDOW_S = 0.1  # over which the size of the residual is averaged


def sensor_failure_figure(
    run: Simulation, segments: Sequence[Segment], exact_nm: Sequence[float], *, title: str = ""
) -> Figure:
    """Residual of a run in which sensors fail: the series of its first case, and its size.

    The size is the mean over all cases. ``exact_nm`` is the stationary residual of each segment
    between failures and returns [nm rms], nan where there is none.
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
