"""Figure of a mirror: its step within the frames, and what the exposures see of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.models import LoopHardware
from lbt_synth.report.figures.style import house_style, new_figure
from lbt_synth.report.line_styles import COLOURS
from lbt_synth.validation import require_instance

_MOST_POINTS = 4000
_SHOWN = 5e-3  # taps after the last one of this size are not drawn


def mirror_figure(hardware: LoopHardware, *, tolerance: float = 0.1) -> Any:
    """Draw the mirror's answer to a step of its command, and its taps.

    Parameters
    ----------
    hardware : LoopHardware
        A loop with a mirror.
    tolerance : float, optional
        Half width of the band in which the mirror counts as settled.

    Returns
    -------
    matplotlib.figure.Figure
        The step response with the ends of the frames after the command's arrival, and the
        weights of the commands in the position averaged over an exposure, those of a settled
        mirror beside them.

    Raises
    ------
    ProblemError
        If the loop has no mirror with dynamics.

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
    from matplotlib.ticker import MaxNLocator

    require_instance(hardware, LoopHardware)
    if hardware.mirror is None:
        raise ProblemError(
            "a figure of the mirror needs one with dynamics; got a mirror that settles at once. "
            "Try LoopHardware(..., mirror=PositionLoop(...))."
        )
    step = hardware.mirror.step_response(tolerance)
    frame_ms = 1e3 * hardware.dt_s
    end_ms = max(1.5 * 1e3 * step.settling_s, 2 * frame_ms)
    time_ms = 1e3 * step.time_s
    if time_ms[-1] < end_ms:  # it has decayed: the rest is its final position
        time_ms = np.append(time_ms, end_ms)
    position = np.append(step.position, 1.0)[: time_ms.size]
    shown = np.flatnonzero(time_ms <= end_ms)
    shown = shown[:: max(1, shown.size // _MOST_POINTS)]
    taps = hardware.mirror_taps
    settled = LoopHardware(
        frame_rate_hz=hardware.frame_rate_hz, delay_frames=hardware.delay_frames, modes=1
    ).mirror_taps
    with house_style():
        figure = new_figure(6.3, 3.2)
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        left.axhspan(1 - tolerance, 1 + tolerance, color="0.9", zorder=0)
        for k in range(1, int(end_ms / frame_ms) + 1):
            left.axvline(
                k * frame_ms,
                color="0.5",
                linestyle=":",
                linewidth=1,
                label="frames" if k == 1 else None,
            )
        left.plot(time_ms[shown], position[shown], color=COLOURS[0])
        left.axvline(
            1e3 * step.settling_s,
            color=COLOURS[1],
            linestyle="--",
            linewidth=1.2,
            label=f"settled to {100 * tolerance:g} %: {1e3 * step.settling_s:.2f} ms",
        )
        left.set(xlabel="time since the command arrived [ms]", ylabel="position / final position")
        left.set_xlim(0, end_ms)
        left.legend(loc="lower right")
        count = max(int(np.flatnonzero(np.abs(taps) > _SHOWN)[-1]) + 1, settled.size)
        index = np.arange(count)
        for shift, name, values, colour in (
            (-0.2, "settled at once", settled, "0.7"),
            (0.2, "this mirror", taps, COLOURS[0]),
        ):
            heights = np.zeros(count)
            heights[: min(count, values.size)] = values[:count]
            right.bar(index + shift, heights, width=0.4, color=colour, label=name)
        right.set(xlabel="frames after the command", ylabel="weight in the exposure")
        right.xaxis.set_major_locator(MaxNLocator(integer=True))
        right.legend(loc="upper right")
    return figure
