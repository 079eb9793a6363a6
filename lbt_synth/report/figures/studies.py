"""The figures of limits, trade-offs, modes and the mirror."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.methods.registry import design_label
from lbt_synth.models import LoopHardware
from lbt_synth.report.charts.description import Area, Axis, Curve, Mark, Panel, Rule, Span
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.figures.loop import stable_curve
from lbt_synth.studies import TradeoffPoint
from lbt_synth.studies.limits import LimitStudy
from lbt_synth.studies.robustness import FAMILIES
from lbt_synth.validation import FloatArray, real_array, require_instance


def limits_figure(study: LimitStudy, *, axes: OwnAxes = None) -> Figure:
    """Draw the residual of each design over the vibration's frequency, and the limits.

    Unstable designs are named and not drawn. A study in which no vibration moves raises a
    ProblemError.
    """
    if study.shift_hz.size < 2:
        raise ProblemError(
            "a figure of limits needs a vibration that moves; got a truth without vibrations, or "
            "a single error. Give truth.vibrations and robustness.errors_hz."
        )
    single = study.frequency_hz is not None
    word = "frequency of the true vibration" if single else "shift of the true vibrations"
    x = Axis(label=word, unit="Hz")
    shifted = study.shift_hz + (study.frequency_hz or 0.0)
    return draw_figure([limits_panel(study, x, shifted, design_label)], axes=axes)


def limits_panel(
    study: LimitStudy, x: Axis, places: FloatArray, label: Callable[[str], str]
) -> Panel:
    """Return the residual of each design, and the limits, over places on an axis."""
    names = [label(row.design) for row in study.rows]
    order = np.argsort(places)
    marks: list[Curve | Rule] = [
        stable_curve(name, names, places[order], curve[order] if row.stable else None)
        for name, row, curve in zip(names, study.rows, study.residual_nm, strict=True)
    ]
    if study.limit is not None and study.limit.rms_nm > 0:
        marks.append(Rule(name="limit, frequency known", at=study.limit.rms_nm, axis="y", dash=3))
    if study.band is not None:
        name = "limit, frequency anywhere in this range"
        marks.append(Rule(name=name, at=study.band.rms_nm, axis="y", dash=1))
    y = Axis(label="residual", unit="nm rms", log=True)
    return Panel(x=x, y=y, marks=tuple(marks), height_in=2.5)


_NAMES = dict(
    zip(FAMILIES, ("least variance at this norm", "central H∞ filter of this norm"), strict=True)
)


def tradeoff_figure(points: Sequence[TradeoffPoint], *, axes: OwnAxes = None) -> Figure:
    """Draw deviation and stable sensor gains over the norm of the estimation error.

    Above, the standard deviation; below, if there are loops, the interval of sensor gains for which
    each is stable. Norms that no filter reaches are shaded.
    """
    if not points:
        raise ProblemError("a trade-off figure needs at least one point; got none.")
    loops = any(point.design.hardware is not None for point in points)
    unit = "nm" if loops else "-"
    norms = [point.gamma for point in points]
    margin = 0.06 * (max(norms) - min(norms)) or 0.01 * max(norms)
    low, high = min(norms) - margin, max(norms) + margin
    x = Axis(label="H∞ norm of the estimation error", unit=unit, low=low, high=high)
    unreached = Span(name="no filter", low=low, high=min(norms))
    errors: list[Mark] = []
    gains: list[Mark] = []
    for look, family in enumerate(dict.fromkeys(point.family for point in points)):
        own = sorted((p for p in points if p.family == family), key=lambda p: p.gamma)
        gamma = np.array([p.gamma for p in own])
        style: dict[str, Any] = {"x": gamma, "look": look, "marker": "own", "size": 4.0}
        name = _NAMES.get(family, family)
        errors.append(Curve(name=name, y=np.array([p.rms for p in own]), **style))
        # an open end is drawn at the border of what is shown
        least = np.array([max(p.gain_low, 1e-2) for p in own])
        most = np.array([min(p.gain_high, 1e2) for p in own])
        gains.append(Area(name="", x=gamma, low=least, high=most, look=look))
        gains += [Curve(name=name, y=ends, **style) for ends in (least, most)]
    kalman: dict[str, Any] = {"line": False, "marker": "circle", "filled": False, "size": 9.0}
    least_rms = np.array([min(p.rms for p in points)])
    errors.append(Curve(name="Kalman", x=np.array([max(norms)]), y=least_rms, look=None, **kalman))
    y = Axis(label="estimation error, rms", unit=unit)
    panels = [Panel(x=x, y=y, marks=(*errors, unreached), height_in=2.3)]
    if loops:
        gains.append(Rule(name="nominal sensor gain", at=1.0, axis="y", dash=1))
        y = Axis(label="sensor gains with a stable loop", unit="-", log=True)
        panels.append(Panel(x=x, y=y, marks=(*gains, unreached), height_in=2.3))
    return draw_figure(panels, axes=axes)


def modal_figure(
    residuals_nm: Mapping[str, ArrayLike],
    *,
    gains: ArrayLike | None = None,
    turbulence_nm: ArrayLike | None = None,
    axes: OwnAxes = None,
) -> Figure:
    """Draw the residual of each mode under several controllers, and integrator gains.

    Parameters
    ----------
    residuals_nm : mapping of str to (n,) array_like
        Residual of each mode [nm rms] by the names of the controllers.
    gains : (n,) array_like, optional
        Integrator gain of each mode, for a panel of its own.
    turbulence_nm : (n,) array_like, optional
        Turbulence of each mode [nm rms], before any correction.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel over the other with a common axis of modes, counted from 1.

    Raises
    ------
    ProblemError
        If there is no controller, a value is not finite or not positive, or lengths differ,
        or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> len(lbt.report.figures.modal_figure({"integrator": [9.0, 5.0]}, gains=[0.5, 0.4]).axes)
    2
    """
    if not residuals_nm:
        raise ProblemError("a modal figure needs the residuals of a controller; got none.")
    given = {"turbulence_nm": turbulence_nm, "gains": gains}
    curves = {
        name: _require_modes(values, name)
        for name, values in (*residuals_nm.items(), *given.items())
        if values is not None
    }
    count = curves[next(iter(residuals_nm))].size
    for name, values in curves.items():
        if values.size != count:
            raise DimensionError(
                f"{name} must have {count} modes like the others; got {values.size}."
            )
    modes = np.arange(1.0, count + 1)
    x = Axis(label="mode, in Noll's order from tip on", log=True, low=1, high=max(count, 2))
    panels = []
    if gains is not None:
        look = len(residuals_nm)  # of none of the residuals, nor of the turbulence
        above = Curve(name="", x=modes, y=curves["gains"], look=look, dash=0, step="center")
        y = Axis(label="integrator gain", low=0)
        panels.append(Panel(x=x, y=y, marks=(above,), height_in=1.7))
    # modes are counted, there is nothing between them
    marks = [
        Curve(name=name, x=modes, y=curves[name], look=look, step="center")
        for look, name in enumerate(residuals_nm)
    ]
    if turbulence_nm is not None:
        y_turbulence = curves["turbulence_nm"]
        marks.insert(
            0,
            Curve(name="turbulence", x=modes, y=y_turbulence, look=None, width=1.0, step="center"),
        )
    y = Axis(label="residual", unit="nm rms", log=True)
    panels.append(Panel(x=x, y=y, marks=tuple(marks), height_in=2.6))
    return draw_figure(panels, axes=axes)


def _require_modes(values: ArrayLike, name: str) -> FloatArray:
    """Return a positive number per mode, (n,)."""
    curve = real_array(values, name)
    if curve.ndim != 1 or curve.size == 0:
        raise DimensionError(
            f"{name} must be a list, one number per mode; got shape {curve.shape}."
        )
    if np.any(curve <= 0):
        raise ProblemError(f"{name} must be above 0; got {curve.min():.6g}.")
    return curve


_MOST_POINTS = 4000
_SHOWN = 5e-3  # taps after the last one of this size are not drawn


def mirror_figure(
    hardware: LoopHardware, *, tolerance: float = 0.1, axes: OwnAxes = None
) -> Figure:
    """Draw the mirror's step response, and its taps.

    The step response has the ends of the frames after the command's arrival, and the band in which
    the mirror counts as settled. The taps are the weights of the commands in the position averaged
    over an exposure, with those of a settled mirror beside them.
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
