"""Figure of a filter that follows a vibration: its frequency, and what was left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification import TrackingUpdate
from lbt_synth.loop import Simulation
from lbt_synth.models import DriftingVibration
from lbt_synth.report.figures.style import house_style, new_figure, plain_ticks
from lbt_synth.report.line_styles import COLOURS, line_styles
from lbt_synth.validation import FloatArray, number


def tracking_figure(
    history: Sequence[TrackingUpdate],
    runs: Mapping[str, Simulation],
    *,
    truth: Sequence[DriftingVibration] = (),
    start_s: float = 0.0,
    bin_s: float = 1.0,
) -> Any:
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

    Returns
    -------
    matplotlib.figure.Figure
        Above, the frequencies that the filter assumed, those fitted to each window at its
        middle, and updates that left the filter as it was; below, the residual in parts of
        ``bin_s``.

    Raises
    ------
    ProblemError
        If there is no update or no run, or a run is shorter than one part.

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
    last_s = max(len(values) for values in residuals.values()) * bin_s
    with house_style():
        figure = new_figure(6.3, 5.0)
        upper, lower = figure.subplots(2, 1, sharex=True)
        time_s = np.linspace(min(0.0, history[0].time_s - start_s), last_s, 1000)
        for i, line in enumerate(truth):
            upper.plot(
                time_s,
                line.frequency_hz_at(time_s),
                color="0.4",
                linewidth=3,
                alpha=0.5,
                label="true frequency" if i == 0 else None,
            )
        _draw_history(upper, history, start_s, last_s)
        upper.set(ylabel="frequency [Hz]")
        upper.legend(loc="best")
        for (name, values), look in zip(residuals.items(), line_styles(), strict=False):
            middles = (np.arange(len(values)) + 0.5) * bin_s
            lower.plot(middles, values, label=name, **look)
        lower.set(xlabel="time [s]", ylabel=f"residual in {bin_s:g} s [nm rms]", yscale="log")
        lower.set_xlim(0, last_s)
        plain_ticks(lower)
        lower.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    return figure


def _draw_history(
    axis: Any, history: Sequence[TrackingUpdate], start_s: float, last_s: float
) -> None:
    ends = [update.time_s - start_s for update in history[1:]]
    ends.append(max(last_s, history[-1].time_s - start_s))
    fitted, kept, first = [], [], True
    for update, end_s in zip(history, ends, strict=True):
        begin_s = update.time_s - start_s
        for frequency in update.frequencies_hz:
            axis.plot(
                [begin_s, end_s],
                [frequency, frequency],
                color=COLOURS[0],
                label="the filter's" if first else None,
            )
            first = False
            if not update.switched:
                kept.append((begin_s, frequency))
        fitted += [(update.middle_s - start_s, value) for value in update.fitted_hz]
    marks = (("window, at its middle", ".", COLOURS[1], fitted), ("kept", "x", COLOURS[3], kept))
    for name, marker, colour, points in marks:
        if points:
            axis.plot(*zip(*points, strict=True), marker, color=colour, markersize=4, label=name)


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
