"""The sigma plot: singular values of estimation errors and closed loops over frequency."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.design import Design, EstimatorDesign
from lbt_synth.errors import ProblemError
from lbt_synth.linear import largest_singular_values
from lbt_synth.loop import close_loop
from lbt_synth.models import TipTiltPlant
from lbt_synth.report.figures.loop import draw_loop_panels
from lbt_synth.report.figures.style import house_style, new_figure, plain_ticks
from lbt_synth.report.frequency_grid import frequency_grid
from lbt_synth.report.line_styles import line_styles


def sigma_figure(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, unit_weights: bool = False
) -> Any:
    """Largest singular values of the estimation error, the rejection and the noise transfer.

    Parameters
    ----------
    designs : mapping of str to Design
        Designs by the name they get in the legend. Those without a loop get
        only the first panel, integrators only the others.
    sensor_gain : float, optional
        Real sensor gain of the closed loops.
    unit_weights : bool, optional
        Draw the estimation error against disturbances of unit size, as the paper
        does, instead of the weighted ones of each design.

    Returns
    -------
    matplotlib.figure.Figure
        One panel per transfer function, the vibration frequencies marked. A loop that is
        unstable at this sensor gain is named and not drawn. With several axes the
        largest singular value is that of the worst one.

    Raises
    ------
    ProblemError
        If there is no design.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> walk = lbt.EstimationProblem(A=0.99, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> figure = lbt.report.figures.sigma_figure({"Kalman": lbt.kalman(walk)})
    >>> len(figure.axes)
    1
    """
    if not designs:
        raise ProblemError("a sigma plot needs at least one design; got none.")
    lines_hz = _vibration_frequencies(designs.values())
    estimators = {k: d for k, d in designs.items() if isinstance(d, EstimatorDesign)}
    loops = {
        name: close_loop(design.hardware, design.controller, sensor_gain=sensor_gain)
        for name, design in designs.items()
        if design.hardware is not None
    }
    styles = dict(zip(designs, line_styles(), strict=False))
    with house_style():
        panels = bool(estimators) + 2 * bool(loops)
        figure = new_figure(6.3, 2.4 * panels + 0.4)
        axes = list(np.atleast_1d(figure.subplots(panels, 1, sharex=True)))
        remaining = iter(axes)
        if estimators:
            axis = next(remaining)
            for name, design in estimators.items():
                problem = design.problem
                problem = problem.with_unit_weights() if unit_weights else problem
                system = design.error_system(problem)
                grid = frequency_grid(1 / system.dt_s, lines_hz)
                axis.loglog(grid, largest_singular_values(system, grid), label=name, **styles[name])
            physical = all(design.hardware is not None for design in estimators.values())
            unit = "nm" if physical and not unit_weights else "-"
            axis.set_ylabel(rf"$\bar\sigma$ disturbances $\to$ error [{unit}]")
        if loops:
            rejection = next(remaining)
            rejection.set_title(f"closed loops at sensor gain {sensor_gain:g}", loc="right")
            draw_loop_panels(rejection, next(remaining), loops, styles, lines_hz)
        for axis in axes:
            _mark_vibrations(axis, lines_hz)
            plain_ticks(axis)
            axis.legend(loc="best")
        axes[-1].set_xlabel("frequency [Hz]")
    return figure


def _vibration_frequencies(designs: Iterable[Design]) -> list[float]:
    found = {
        line.frequency_hz
        for design in designs
        if isinstance(design, EstimatorDesign) and isinstance(design.problem, TipTiltPlant)
        for line in design.problem.vibrations
    }
    return sorted(found)


def _mark_vibrations(axis: Any, lines_hz: Sequence[float]) -> None:
    for i, frequency in enumerate(lines_hz):
        axis.axvline(
            frequency,
            color="0.35",
            linestyle=":",
            linewidth=1.0,
            label="vibration" if i == 0 else None,
            zorder=0,
        )
