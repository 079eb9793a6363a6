"""Figure of a mirror: its step within the frames, and what the exposures see of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.models import LoopHardware
from lbt_synth.report.charts.description import Area, Axis, Curve, Panel, Rule, Span
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.validation import FloatArray, require_instance

_MOST_POINTS = 4000
_SHOWN = 5e-3  # taps after the last one of this size are not drawn


def mirror_figure(
    hardware: LoopHardware, *, tolerance: float = 0.1, axes: OwnAxes = None
) -> Figure:
    """Draw the mirror's step response, and its taps.

    Parameters
    ----------
    hardware : LoopHardware
        A loop with a mirror.
    tolerance : float, optional
        Half width of the band in which the mirror counts as settled.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        The step response with the ends of the frames after the command's arrival, and the
        weights of the commands in the position averaged over an exposure, those of a settled
        mirror beside them.

    Raises
    ------
    ProblemError
        If the loop has no mirror with dynamics,
        or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> shell = lbt.models.PositionLoop.from_bandwidth(
    ...     natural_frequency_hz=50, damping=0.5, bandwidth_hz=500
    ... )
    >>> len(
    ...     lbt.report.figures.mirror_figure(lbt.LoopHardware(frame_rate_hz=800, mirror=shell)).axes
    ... )
    2
    """
    require_instance(hardware, LoopHardware)
    if hardware.mirror is None:
        raise ProblemError(
            "a figure of the mirror needs one with dynamics; got a mirror that settles at once. "
            "Try LoopHardware(..., mirror=PositionLoop(...))."
        )
    step = hardware.mirror.step_response(tolerance)
    settling_ms, frame_ms = 1e3 * step.settling_s, 1e3 * hardware.dt_s
    end_ms = max(1.5 * settling_ms, 2 * frame_ms)
    time_ms = 1e3 * step.time_s
    if time_ms[-1] < end_ms:  # it has decayed: the rest is its final position
        time_ms = np.append(time_ms, end_ms)
    position = np.append(step.position, 1.0)[: time_ms.size]
    shown = np.flatnonzero(time_ms <= end_ms)
    shown = shown[:: max(1, shown.size // _MOST_POINTS)]
    settled = f"settled to {100 * tolerance:g} %: {settling_ms:.2f} ms"
    response = Panel(
        x=Axis(label="time since the command arrived", unit="ms", low=0, high=end_ms),
        y=Axis(label="position / final position"),
        marks=(
            Span(name="", axis="y", low=1 - tolerance, high=1 + tolerance),
            Curve(name="this mirror", x=time_ms[shown], y=position[shown]),
            *(
                Rule(name="frames", at=k * frame_ms, dash=3)
                for k in range(1, int(end_ms / frame_ms) + 1)
            ),
            Rule(name=settled, at=settling_ms, dash=1),
        ),
        height_in=2.4,
    )
    taps = hardware.mirror_taps
    ideal = replace(hardware, mirror=None).mirror_taps
    count = max(int(np.flatnonzero(np.abs(taps) > _SHOWN)[-1]) + 1, ideal.size)
    weights = Panel(
        x=Axis(label="frames after the command", low=-0.6, high=count - 0.4),
        y=Axis(label="weight in the exposure"),
        marks=(
            _columns("this mirror", taps[:count], 0.0, look=0),
            _columns("settled at once", ideal[:count], -0.4, look=None),
        ),
        height_in=2.4,
    )
    return draw_figure((response, weights), columns=2, axes=axes)


def _columns(name: str, heights: FloatArray, offset: float, *, look: int | None) -> Area:
    """Return upright bars of width 0.4 that begin at an offset from 0, 1 and so on."""
    left = np.arange(heights.size) + offset
    x = np.column_stack((left, left, left + 0.4, left + 0.4)).ravel()
    high = np.column_stack((0 * heights, heights, heights, 0 * heights)).ravel()
    return Area(name=name, x=x, low=np.zeros(x.size), high=high, look=look, solid=look is not None)
