"""The sigma plot: singular values of estimation errors and closed loops over frequency."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.linear import largest_singular_values
from lbt_synth.loop import close_loop
from lbt_synth.models import TipTiltPlant
from lbt_synth.report.charts.description import Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.figures.loop import (
    frequency_grid,
    frequency_panel,
    loop_norms,
    loop_panels,
    stable_curve,
    vibration_rules,
)
from lbt_synth.validation import FloatArray

# Frequencies [Hz], largest singular values of error, rejection and noise transfer, (f,) each; None
# for what a design does not have, or an unstable loop
SigmaCurves = tuple[FloatArray, FloatArray | None, FloatArray | None, FloatArray | None]


def sigma_figure(
    designs: Mapping[str, Design],
    *,
    sensor_gain: float = 1.0,
    unit_weights: bool = False,
    axes: OwnAxes = None,
) -> Figure:
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
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel per transfer function, the vibration frequencies marked. A loop that is
        unstable at this sensor gain is named and not drawn. With several axes the
        largest singular value is that of the worst one.

    Raises
    ------
    ProblemError
        If there is no design,
        or ``axes`` are not one per panel.

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
    names, rules = list(designs), vibration_rules(_vibration_frequencies(designs.values()))
    found = sigma_curves(designs, sensor_gain=sensor_gain, unit_weights=unit_weights)
    errors = [
        stable_curve(name, names, f, error)
        for name, (f, error, *_) in found.items()
        if error is not None
    ]
    norms = {
        name: (f, rejection, noise)
        for name, (f, _, rejection, noise) in found.items()
        if designs[name].hardware is not None
    }
    panels: list[Panel] = []
    if errors:
        estimators = [each for each in designs.values() if each.is_estimator]
        physical = all(design.hardware is not None for design in estimators)
        unit = "nm" if physical and not unit_weights else "-"
        panels.append(frequency_panel("disturbances to error", unit, errors, rules))
    if norms:
        title = f"closed loops at sensor gain {sensor_gain:g}"
        panels += loop_panels(norms, rules, names, title=title)
    return draw_figure(panels, axes=axes)


def sigma_curves(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, unit_weights: bool = False
) -> dict[str, SigmaCurves]:
    """Return what is drawn of each design, over frequencies that are dense around vibrations."""
    lines_hz, found = _vibration_frequencies(designs.values()), {}
    for name, design in designs.items():
        f, error = frequency_grid(1 / design.controller.dt_s, lines_hz), None
        rejection = noise = None
        if design.is_estimator:
            problem = design.problem
            system = design.error_system(problem.with_unit_weights() if unit_weights else problem)
            error = largest_singular_values(system, f)
        if design.hardware is not None:
            loop = close_loop(design.hardware, design.controller, sensor_gain=sensor_gain)
            _, rejection, noise = loop_norms(loop, lines_hz)
        found[name] = f, error, rejection, noise
    return found


def _vibration_frequencies(designs: Iterable[Design]) -> list[float]:
    found = {
        line.frequency_hz
        for design in designs
        if design.is_estimator and isinstance(design.problem, TipTiltPlant)
        for line in design.problem.vibrations
    }
    return sorted(found)
