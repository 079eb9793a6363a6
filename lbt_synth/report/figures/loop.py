"""Figure of closed loops: how much disturbance each rejects, and how much noise it passes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lbt_synth.errors import ProblemError
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import ClosedLoop
from lbt_synth.report.figures.style import house_style, new_figure
from lbt_synth.report.frequency_grid import frequency_grid
from lbt_synth.report.line_styles import line_styles


def loop_figure(loops: Mapping[str, ClosedLoop]) -> Any:
    """Rejection and noise transfer of closed loops.

    Parameters
    ----------
    loops : mapping of str to ClosedLoop
        Loops by the name they get in the legend.

    Returns
    -------
    matplotlib.figure.Figure
        Two panels.

    Raises
    ------
    ProblemError
        If there is no loop.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller)
    >>> len(lbt.report.figures.loop_figure({"integrator": loop}).axes)
    2
    """
    if not loops:
        raise ProblemError("a loop figure needs at least one loop; got none.")
    with house_style():
        figure = new_figure(6.3, 5.0)
        top, bottom = figure.subplots(2, 1, sharex=True)
        draw_loop_panels(top, bottom, loops, dict(zip(loops, line_styles(), strict=False)), [])
        top.legend(loc="best")
        bottom.legend(loc="best")
        bottom.set_xlabel("frequency [Hz]")
    return figure


def draw_loop_panels(
    rejection: Any,
    noise: Any,
    loops: Mapping[str, ClosedLoop],
    styles: Mapping[str, dict[str, Any]],
    lines_hz: Sequence[float],
) -> None:
    """Draw rejection and noise transfer; a loop that is unstable is only named in the legend."""
    for name, loop in loops.items():
        if not loop.is_stable:
            for axis in (rejection, noise):
                axis.plot([], [], label=f"{name}: unstable", **styles[name])
            continue
        grid = frequency_grid(loop.hardware.frame_rate_hz, lines_hz)
        for axis, response in (
            (rejection, loop.sensitivity(grid)),
            (noise, loop.noise_transfer(grid)),
        ):
            axis.loglog(grid, spectral_norms(response), label=name, **styles[name])
    rejection.axhline(1, color="0.4", linewidth=0.8)
    rejection.set_ylabel(r"$\bar\sigma$ phase $\to$ residual [-]")
    noise.set_ylabel(r"$\bar\sigma$ noise $\to$ residual [-]")
