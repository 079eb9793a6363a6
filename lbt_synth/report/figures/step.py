"""Figure of step responses: residual and command after a step of the wavefront."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lbt_synth.design import Design
from lbt_synth.loop import step_response
from lbt_synth.loop.simulation.run import SHOWN_FRAMES, LoopStep
from lbt_synth.report.charts.description import Axis, Curve, Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.figures.loop import stable_curve
from lbt_synth.report.figures.open_loops import axes_name, closed_loops

Steps = dict[str, tuple[LoopStep, ...]]  # of each design; none where the loop is unstable


def design_steps(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, frames: int = SHOWN_FRAMES
) -> Steps:
    """Return the step responses of designs; axes that respond alike are one."""
    steps: Steps = {}
    for name, loop in closed_loops(designs, sensor_gain).items():
        unlike: list[LoopStep] = []
        for axis in range(loop.hardware.modes if loop.is_stable else 0):
            found = step_response(loop, axis=axis, frames=frames)
            if not any(np.allclose(found.residual, each.residual) for each in unlike):
                unlike.append(found)
        steps[name] = tuple(unlike)
    return steps


def step_figure(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, axes: OwnAxes = None
) -> Figure:
    """Residual and command of loops after a step of the wavefront.

    Parameters
    ----------
    designs : mapping of str to Design
        Designs by the name they get in the legend; each needs a loop.
    sensor_gain : float, optional
        Real sensor gain, relative to the one of each design.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Two panels. Axes that respond alike are one curve.

    Raises
    ------
    ProblemError
        If there is no design, one has no loop, or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4)
    >>> len(lbt.report.figures.step_figure({"slow": slow}).axes)
    2
    """
    steps, panels = design_steps(designs, sensor_gain=sensor_gain), []
    names = list(designs)
    for label in ("residual", "command"):
        curves: list[Curve] = []
        for design, found in steps.items():
            if not found:
                curves.append(stable_curve(design, names, [], None))
            for number, each in enumerate(found):
                look = names.index(design)
                curves.append(
                    Curve(
                        name=axes_name(design, [each.axis], alone=len(found) == 1),
                        x=1e3 * each.time_s,
                        y=getattr(each, label),
                        look=look,
                        dash=look + number if number else None,
                        step="after",
                    )
                )
        x = Axis(label="time after the step", unit="ms")
        y = Axis(label=f"{label}, part of the step", unit="-")
        panels.append(Panel(x=x, y=y, marks=tuple(curves)))
    return draw_figure(panels, axes=axes)
