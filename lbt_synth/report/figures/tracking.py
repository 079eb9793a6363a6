"""Figure of a filter that follows a vibration: its frequency, and what was left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification import TrackingUpdate
from lbt_synth.loop import Simulation
from lbt_synth.models import DriftingVibration
from lbt_synth.report.charts.description import Axis, Curve, Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.validation import FloatArray, number


def tracking_figure(
    history: Sequence[TrackingUpdate],
    runs: Mapping[str, Simulation],
    *,
    truth: Sequence[DriftingVibration] = (),
    start_s: float = 0.0,
    bin_s: float = 1.0,
    axes: OwnAxes = None,
) -> Figure:
    """Draw the frequencies that a filter followed, and the residuals of several runs.

    Parameters
    ----------
    history : sequence of TrackingUpdate
        Updates of a :class:`TrackingController`.
    runs : mapping of str to Simulation
        Runs by the name they get in the legend; of each the first case is drawn.
    truth : sequence of DriftingVibration, optional
        The vibrations as they really are.
    start_s : float, optional
        Time of the first kept frame of the runs since the reset of the loop [s]: the frames of
        settling.
    bin_s : float, optional
        Length of the parts of which the residual is drawn [s].
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Above, the frequencies that the filter assumed, those fitted to each window at its
        middle, and updates that left the filter as it was; below, the residual in parts of
        ``bin_s``.

    Raises
    ------
    ProblemError
        If there is no update or no run, or a run is shorter than one part,
        or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> tracker = lbt.identification.TrackingController(
    ...     plant, lbt.identification.LineFollower(plant), window_s=1
    ... )
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=15.5)
    >>> run = lbt.simulate(tracker, truth, hardware=plant.hardware, frames=1600)
    >>> len(lbt.report.figures.tracking_figure(tracker.history, {"tracking": run}).axes)
    2
    """
    if not history or not runs:
        raise ProblemError(
            "a figure of tracking needs at least one update and one run; got "
            f"{len(history)} and {len(runs)}."
        )
    number(start_s, "start_s")
    number(bin_s, "bin_s", above=0)
    residuals = {name: _rms_in_parts(name, run, bin_s) for name, run in runs.items()}
    last_s = max(values.size for values in residuals.values()) * bin_s
    time_s = np.linspace(min(0.0, history[0].time_s - start_s), last_s, 1000, dtype=np.float64)
    frequencies = [
        Curve(name="true frequency", x=time_s, y=line.frequency_hz_at(time_s), look=None, width=3.0)
        for line in truth
    ]
    frequencies += _history_curves(history, start_s, last_s)
    curves = [
        Curve(
            name=name,
            x=(np.arange(values.size, dtype=np.float64) + 0.5) * bin_s,
            y=values,
            look=look,
        )
        for look, (name, values) in enumerate(residuals.items())
    ]
    x = Axis(label="time", unit="s", low=0, high=last_s)
    panels = (
        Panel(x=x, y=Axis(label="frequency", unit="Hz"), marks=tuple(frequencies), height_in=2.2),
        Panel(
            x=x,
            y=Axis(label=f"residual in {bin_s:g} s", unit="nm rms", log=True),
            marks=tuple(curves),
            height_in=2.2,
        ),
    )
    return draw_figure(panels, axes=axes)


def _history_curves(
    history: Sequence[TrackingUpdate], start_s: float, last_s: float
) -> list[Curve]:
    """Return the frequencies of the filter and of the windows, and those that it kept."""
    ends = [update.time_s - start_s for update in history[1:]]
    ends.append(max(last_s, history[-1].time_s - start_s))
    held: list[tuple[float, float]] = []
    fitted: list[tuple[float, float]] = []
    kept: list[tuple[float, float]] = []
    for update, end_s in zip(history, ends, strict=True):
        begin_s = update.time_s - start_s
        for frequency in update.frequencies_hz:  # lines that are not joined
            if begin_s < end_s:
                held += [(begin_s, frequency), (end_s, frequency), (np.nan, np.nan)]
            if not update.switched:
                kept.append((begin_s, frequency))
        fitted += [(update.middle_s - start_s, value) for value in update.fitted_hz]
    fitted, kept = ([p for p in points if 0 < p[0] < last_s] for points in (fitted, kept))
    styles = (
        ("the filter's", held, {"look": 5, "dash": 0}),  # no look of the first runs
        ("window, at its middle", fitted, {"look": 1, "line": False, "marker": "circle"}),
        ("kept", kept, {"look": 3, "line": False, "marker": "cross"}),
    )
    return [
        Curve(name=name, x=np.array(points)[:, 0], y=np.array(points)[:, 1], size=3.0, **style)
        for name, points, style in styles
        if points
    ]


def _rms_in_parts(name: str, run: Simulation, bin_s: float) -> FloatArray:
    """Residual of the first case over all modes, in parts of a length [nm rms]."""
    power = np.sum(run.residual_nm[0] ** 2, axis=1)
    each = max(1, round(bin_s * run.frame_rate_hz))
    parts = len(power) // each
    if parts == 0:
        raise ProblemError(
            f"a run must be at least {bin_s:g} s long; got {len(power) / run.frame_rate_hz:.3g} s "
            f"of {name!r}. Give a shorter bin_s."
        )
    return np.asarray(np.sqrt(power[: parts * each].reshape(parts, each).mean(axis=1)))
