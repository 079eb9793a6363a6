"""Figures of studies: robustness, maps, limits, trade-offs, modes, the mirror, end to end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.interop.specula.simulation import EndToEndRun
from lbt_synth.methods.registry import design_label
from lbt_synth.models import LoopHardware
from lbt_synth.report.draw import PANEL_IN, Figure, OwnAxes, count_columns, drawing
from lbt_synth.report.figures.loops import draw_design
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts
from lbt_synth.studies.limits import LimitStudy
from lbt_synth.studies.robustness import FAMILIES, RobustnessMap, RobustnessRow
from lbt_synth.validation import FloatArray, positive, require_instance

FREQUENCY_ERROR = {"label": "frequency error, truth less design", "unit": "Hz"}
SENSOR_GAIN = {"label": "sensor gain", "unit": "-"}
SHORT_FREQUENCY_ERROR = {"label": "frequency error", "unit": "Hz"}  # of narrow panels
_POINTS: dict[str, Any] = {"marker": "own", "size": 4.0}
_RINGS: dict[str, Any] = {"line": False, "marker": "own", "filled": False, "size": 9.0}


def robustness_figure(
    rows: Sequence[RobustnessRow],
    published: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    *,
    axes: OwnAxes = None,
) -> Figure:
    """Draw the Strehl ratio over the error of the model's vibration frequency.

    Parameters
    ----------
    rows : sequence of RobustnessRow
        Rows of :func:`lbt_synth.studies.robustness`; unstable ones are marked at the bottom.
    published : mapping, optional
        For each method, pairs (error [Hz], Strehl ratio [%]) drawn as open markers.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes, one; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel.

    Raises
    ------
    ProblemError
        If there are no rows, or ``axes`` are not one.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> parts = config.plant, config.truth, config.imaging
    >>> rows = list(lbt.studies.robustness(*parts, errors_hz=[0]))
    >>> len(lbt.report.figures.robustness_figure(rows).axes)
    1
    """
    if not rows:
        raise ProblemError("a robustness figure needs at least one row; got none.")
    strehls = [100 * row.strehl if row.stable else 0.0 for row in rows]
    papers = [strehl for points in (published or {}).values() for _, strehl in points]
    with drawing([2.5], axes=axes) as (panel,):
        panel.set_axes(FREQUENCY_ERROR, strehl_axis([*strehls, *papers]))
        for look, method in enumerate(dict.fromkeys(row.method for row in rows)):
            entries = sorted((r for r in rows if r.method == method), key=lambda r: r.error_hz)
            label, errors = design_label(method), np.array([r.error_hz for r in entries])
            stable = np.array([r.stable for r in entries])
            if stable.any():
                y = np.where(stable, [100 * r.strehl for r in entries], np.nan)
                panel.curve(label, errors, y, look=look, **_POINTS)
            if not stable.all():
                lost, name = errors[~stable], f"{label}: unstable"
                panel.curve(name, lost, 0 * lost, look=look, line=False, marker="x")
            if published is not None and method in published:
                x, y = np.array(published[method], dtype=float).T
                panel.curve(f"{label}, paper", x, y, look=look, **_RINGS | {"size": 7.0})
    return panel.figure


def strehl_axis(percents: ArrayLike) -> dict[str, Any]:
    """Return the axis of Strehl ratios, from a multiple of 10 % or 1 % below the least on."""
    values = np.asarray(percents, dtype=np.float64)
    values = values[np.isfinite(values)]
    least, most = (values.min(), values.max()) if values.size else (0.0, 100.0)
    step = 10.0 if most - least > 10 else 1.0  # of the lower end
    low = max(0.0, step * np.floor(least / step - 0.5))
    return {"label": "Strehl ratio", "unit": "%", "low": low}


def robustness_map_figure(
    maps: Mapping[str, RobustnessMap], *, real_gain: float | None = None, axes: OwnAxes = None
) -> Figure:
    """Draw the Strehl ratio of designs over frequency error and sensor gain.

    Parameters
    ----------
    maps : mapping of str to RobustnessMap
        Maps of :func:`lbt_synth.studies.robustness_map` by the names of their designs.
    real_gain : float, optional
        Sensor gain that is marked.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel per delay error and design, up to three side by side, with one colour bar for
        all. Sensor gains at which the loop is unstable are hatched.

    Raises
    ------
    ProblemError
        If there is no map, their delay errors differ, or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = lbt.integrator(config.hardware, gain=0.5)
    >>> errors = {"errors_hz": [0], "sensor_gains": [1, 3]}
    >>> map = lbt.studies.robustness_map(slow, config.truth, config.imaging, **errors)
    >>> figure = lbt.report.figures.robustness_map_figure({"slow": map})
    >>> len(figure.axes)  # one panel and the colour bar
    2
    """
    if not maps:
        raise ProblemError("a map figure needs at least one map; got none.")
    delays = next(iter(maps.values())).delay_errors_frames
    for name, grid in maps.items():
        if not np.array_equal(grid.delay_errors_frames, delays):
            raise ProblemError(
                f"the maps must have the same delay errors {delays.tolist()}; got "
                f"{grid.delay_errors_frames.tolist()} for {name}."
            )
    columns = min(len(maps), 3) if len(delays) > 1 else count_columns(len(maps))
    # the long name of the axis does not fit three columns
    x_axis = FREQUENCY_ERROR if columns < 3 else SHORT_FREQUENCY_ERROR
    heights = [2.3] * (len(delays) * len(maps))
    with drawing(heights, columns=columns, axes=axes) as panels:
        drawn = [(row, *named) for row in range(len(delays)) for named in maps.items()]
        for panel, (row, name, grid) in zip(panels, drawn, strict=True):
            late = f", delay error {delays[row]:+g} frames" if np.any(delays) else ""
            panel.set_axes(x_axis, SENSOR_GAIN, title=f"{name}{late}")
            across, up = np.argsort(grid.errors_hz), np.argsort(grid.sensor_gains)
            errors_hz, gains = grid.errors_hz[across], grid.sensor_gains[up]
            values = 100 * grid.strehl[row][np.ix_(up, across)]
            scale: dict[str, Any] = {"contours": True, "blank": "unstable loop"}
            panel.map(errors_hz, gains, values, "Strehl ratio", "%", **scale)
            if real_gain is not None and gains[0] <= real_gain <= gains[-1]:
                panel.rule("real sensor gain", real_gain, "y", dash=1)
    return panels[0].figure


def limits_figure(study: LimitStudy, *, over_errors: bool = False, axes: OwnAxes = None) -> Figure:
    """Draw the residual of each design over the vibration's frequency or its error, and the limits.

    Designs that leave the same are one curve with their names; unstable ones are named and not
    drawn. A study in which no vibration moves raises a ProblemError.
    """
    if study.shift_hz.size < 2:
        raise ProblemError(
            "a figure of limits needs a vibration that moves; got a truth without vibrations, or "
            "a single error. Give truth.vibrations and robustness.errors_hz."
        )
    start_hz, x_axis = 0.0, FREQUENCY_ERROR
    if not over_errors:
        shift = "shift of the vibration that moves most, the others in proportion"
        label = shift if study.frequency_hz is None else "frequency of the true vibration"
        start_hz, x_axis = study.frequency_hz or 0.0, {"label": label, "unit": "Hz"}
    order, places = np.argsort(study.shift_hz), np.sort(study.shift_hz) + start_hz
    curves: list[tuple[str, FloatArray | None]] = []
    for row, residual_nm in zip(study.rows, study.residual_nm, strict=True):
        name = row.design if over_errors else design_label(row.design)
        values = residual_nm[order] if row.stable else None
        for i, (twin, other) in enumerate(curves):
            if values is not None and other is not None and np.allclose(values, other, rtol=1e-9):
                curves[i] = f"{twin} and {name}", other
                break
        else:
            curves.append((name, values))
    with drawing([2.5], axes=axes) as (panel,):
        panel.set_axes(x_axis, {"label": "residual", "unit": "nm rms", "log": True})
        for name, values in curves:
            draw_design(panel, [title for title, _ in curves], name, places, values)
        if study.limit is not None and study.limit.rms_nm > 0:
            panel.rule("limit, frequency known", study.limit.rms_nm, "y", dash=3)
        if study.band is not None:
            panel.rule("limit, frequency anywhere in this range", study.band.rms_nm, "y", dash=1)
    return panel.figure


_NAMES = dict(
    zip(FAMILIES, ("least variance at this norm", "central H∞ filter of this norm"), strict=True)
)


def tradeoff_figure(points: Sequence[Facts], *, axes: OwnAxes = None) -> Figure:
    """Draw deviation and stable sensor gains over the norm of the estimation error.

    Above, the standard deviation; below, if there are loops, the interval of sensor gains for which
    each is stable. An end of it that is 0 has no line: the shaded area goes on to the edge. Norms
    that no filter reaches are shaded.
    """
    if not points:
        raise ProblemError("a trade-off figure needs at least one point; got none.")
    loops = any(point.design.hardware is not None for point in points)
    unit = "nm" if loops else "-"
    norms = [point.gamma for point in points]
    margin = 0.06 * (max(norms) - min(norms)) or 0.01 * max(norms)
    low, high = min(norms) - margin, max(norms) + margin
    x_axis = {"label": "H∞ norm of the estimation error", "unit": unit, "low": low, "high": high}
    shown_gains = {"label": "sensor gains with a stable loop", "unit": "-", "log": True}
    with drawing([2.3] * (1 + loops), axes=axes) as panels:
        panels[0].set_axes(x_axis, {"label": "estimation error, rms", "unit": unit})
        ends = [end for p in points for end in (p.gain_low, p.gain_high) if 0 < end < np.inf]
        edges = min([1.0, *ends]) / 2, 2 * max([1.0, *ends])
        if loops:
            panels[1].set_axes(x_axis, shown_gains | {"low": edges[0], "high": edges[1]})
        for look, family in enumerate(dict.fromkeys(point.family for point in points)):
            entries = sorted((p for p in points if p.family == family), key=lambda p: p.gamma)
            gamma, name = np.array([p.gamma for p in entries]), _NAMES.get(family, family)
            panels[0].curve(name, gamma, [p.rms for p in entries], look=look, **_POINTS)
            if not loops:
                continue
            interval = np.array([(p.gain_low, p.gain_high) for p in entries]).T
            panels[1].area("", gamma, *np.clip(interval, *edges), look=look)
            for gains in interval:
                inside = np.where((gains > 0) & (gains < np.inf), gains, np.nan)
                panels[1].curve(name, gamma, inside, look=look, **_POINTS)
        least = min(point.rms for point in points)
        panels[0].curve("Kalman", [max(norms)], [least], look=None, **_RINGS)
        if loops:
            panels[1].rule("nominal sensor gain", 1.0, "y", dash=1)
        for panel in panels:
            panel.span("no filter", low, min(norms))
    return panels[0].figure


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
        Your own matplotlib axes, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel over the other with a common axis of modes, counted from 1.

    Raises
    ------
    ProblemError
        If there is no controller, a value is not positive, or lengths or ``axes`` do not fit.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> len(lbt.report.figures.modal_figure({"integrator": [9.0, 5.0]}, gains=[0.5, 0.4]).axes)
    2
    """
    if not residuals_nm:
        raise ProblemError("a modal figure needs the residuals of a controller; got none.")
    others = {"turbulence_nm": turbulence_nm, "gains": gains}
    numbers = {**residuals_nm, **others}
    curves = {n: positive(values, n) for n, values in numbers.items() if values is not None}
    count = curves[next(iter(residuals_nm))].size
    for name, curve in curves.items():
        if curve.shape != (count,) or not count:
            raise DimensionError(
                f"{name} must have {count} modes, one number per mode; got shape {curve.shape}."
            )
    modes = np.arange(1.0, count + 1)
    label = "mode, in Noll's order from tip on"
    x_axis = {"label": label, "log": True, "low": 1, "high": max(count, 2)}
    step = "steps-mid"  # modes are counted, there is nothing between them
    with drawing([1.7] * (gains is not None) + [2.6], axes=axes) as panels:
        if gains is not None:
            look = len(residuals_nm)  # of none of the residuals, nor of the turbulence
            panels[0].set_axes(x_axis, {"label": "integrator gain", "low": 0})
            y = curves["gains"]
            panels[0].curve("integrator gain", modes, y, look=look, dash=0, step=step, quiet=True)
        panels[-1].set_axes(x_axis, {"label": "residual", "unit": "nm rms", "log": True})
        if turbulence_nm is not None:
            y = curves["turbulence_nm"]
            panels[-1].curve("turbulence", modes, y, look=None, width=1.0, step=step)
        for name in residuals_nm:
            draw_design(panels[-1], list(residuals_nm), name, modes, curves[name], step=step)
    return panels[0].figure


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
    shown = time_ms <= end_ms
    taps = hardware.mirror_taps
    ideal = replace(hardware, mirror=None).mirror_taps
    count = max(np.trim_zeros(taps.round(2), "b").size, ideal.size)  # of half a percent and more
    time = {"label": "time since the command arrived", "unit": "ms", "low": 0, "high": end_ms}
    with drawing([2.4, 2.4], columns=2, axes=axes) as (response, weights):
        response.set_axes(time, {"label": "position / final position"})
        response.span("", 1 - tolerance, 1 + tolerance, "y")
        response.curve("this mirror", time_ms[shown], position[shown])
        for k in range(1, int(end_ms / frame_ms) + 1):
            response.rule("frames", k * frame_ms, dash=3)
        settled = f"settled to {100 * tolerance:g} %: {settling_ms:.2f} ms"
        response.rule(settled, settling_ms, dash=1)
        x_axis = {"label": "frames after the command", "low": -0.6, "high": count - 0.4}
        weights.set_axes(x_axis, {"label": "weight in the exposure"})
        for name, values, look in (("settled at once", ideal, None), ("this mirror", taps, 0)):
            heights = np.zeros(count)
            heights[: values.size] = values[:count]
            weights.curve(name, np.arange(count), heights, look=look, step="steps-mid")
    return response.figure


_SHOWN_MAS = 700.0  # from the centre of the image to its edges
_FAINTEST = 1e-5  # of the peak


def end_to_end_figure(run: EndToEndRun, *, axes: OwnAxes = None) -> Figure:
    """Image, tip and tilt over time, and residual of each mode of an end-to-end run."""
    size = run.psf.shape[0]
    position_mas = (np.arange(size) - size // 2) * run.psf_pixel_mas
    reach_mas = min(_SHOWN_MAS, size / 2 * run.psf_pixel_mas)
    seconds = np.arange(run.frames) / run.setup.hardware.frame_rate_hz
    x_axis, y_axis = (
        {"label": name, "unit": "mas", "low": -reach_mas, "high": reach_mas} for name in "xy"
    )
    with drawing([2.4, 2.4, PANEL_IN], columns=2, axes=axes) as (image, modes, series):
        title = f"{run.setup.imaging_wavelength_um:g} µm, Strehl ratio {100 * run.strehl:.1f} %"
        image.set_axes(x_axis, y_axis, title=title, equal=True)
        values = np.maximum(run.psf / run.psf.max(), _FAINTEST)
        image.map(position_mas, position_mas, values, "intensity / peak", log=True)
        x_axis = {"label": "mode (1 tip, 2 tilt)", "log": True}
        y_axis = {"label": "residual", "unit": "nm rms", "log": True}
        modes.set_axes(x_axis, y_axis, title="all modes")
        numbers = np.arange(1.0, run.setup.modes + 1)
        modes.curve("residual", numbers, run.rms_nm, width=0.8, quiet=True)
        y_axis = {"label": "residual", "unit": "nm rms wavefront"}
        series.set_axes({"label": "time", "unit": "s"}, y_axis, title="tip and tilt")
        for axis, name in enumerate(("tip", "tilt")):
            label = f"{name}, {nm_text(run.rms_nm[axis], '.0f', unit='nm rms')}"
            series.curve(label, seconds, run.residual_nm[:, axis], look=axis, width=0.8, dash=0)
    return image.figure


def end_to_end_table_figure(entries: Sequence[Facts]) -> Figure:
    """Strehl ratios of Table III by end-to-end simulation, the modal analysis and the paper."""
    rows = [e for e in entries if e.table == "III" and e.error_hz is not None]
    methods = list(dict.fromkeys(e.method for e in rows))
    x_axis = FREQUENCY_ERROR if len(methods) < 3 else SHORT_FREQUENCY_ERROR
    y_axis = {"label": "Strehl ratio at 2.2 µm", "unit": "%", "low": 0, "high": 100}
    with drawing([2.3] * len(methods), columns=len(methods)) as panels:
        for panel, method in zip(panels, methods, strict=True):
            panel.set_axes(x_axis, y_axis, title=design_label(method))
            names = ("error_hz", "paper", "modal", "strehl", "scatter")
            entries = [e for e in rows if e.method == method]
            error, paper, modal, strehl, scatter = (
                np.array([getattr(e, name) for e in entries], dtype=float) for name in names
            )
            if not np.isnan(paper[0]):  # it published none of its own integrator
                panel.curve("Agapito et al. 2008", error, paper, look=3, **_POINTS)
            panel.curve("modal, measured optical gain", error, modal, look=1)
            panel.curve("end to end", error, strehl, error=scatter, look=0, **_POINTS)
    return panels[0].figure
