"""Figures of studies: robustness, maps, limits, trade-offs, modes, the mirror, end to end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.interop.specula.simulation import EndToEndRun
from lbt_synth.methods.registry import design_label
from lbt_synth.models import LoopHardware, PositionLoop
from lbt_synth.report.draw import (
    GUIDE,
    PANEL_IN,
    SHADE,
    Figure,
    OwnAxes,
    colour,
    dot_style,
    draw_map,
    drawing,
    line_style,
    name_axes,
)
from lbt_synth.report.figures.loops import draw_design
from lbt_synth.storage.display_unit import nm_text, own_display_unit
from lbt_synth.storage.rows import Facts
from lbt_synth.studies.limits import LimitStudy
from lbt_synth.studies.robustness import FAMILIES, RobustnessMap
from lbt_synth.validation import FloatArray

FREQUENCY_ERROR = ("frequency error, truth less design", "Hz")
SENSOR_GAIN = ("sensor gain", "-")
SHORT_FREQUENCY_ERROR = ("frequency error", "Hz")  # of narrow panels
STREHL = ("Strehl ratio", "%")
_RINGS: dict[str, Any] = {"linestyle": "none", "markerfacecolor": "none", "markersize": 8.0}


def robustness_figure(
    rows: Sequence[Facts], published: Mapping[str, Sequence[tuple[float, float]]]
) -> Figure:
    """Draw the Strehl ratio over the frequency error, and the pairs that were published.

    Unstable loops are marked at the bottom, published pairs (error [Hz], Strehl ratio [%]) with
    open markers.
    """
    with drawing([2.5]) as (panel,):
        name_axes(panel, FREQUENCY_ERROR, STREHL)
        for look, method in enumerate(dict.fromkeys(row.method for row in rows)):
            entries = sorted((r for r in rows if r.method == method), key=lambda r: r.error_hz)
            label, errors = design_label(method), np.array([r.error_hz for r in entries])
            stable = np.array([r.stable for r in entries])
            if stable.any():
                y = np.where(stable, [100 * r.strehl for r in entries], np.nan)
                panel.plot(errors, y, label=label, **dot_style(look))
            if not stable.all():
                lost = errors[~stable]
                panel.plot(lost, 0 * lost, "x", label=f"{label}: unstable", color=colour(look))
            if method in published:
                x, y = np.array(published[method], dtype=float).T
                panel.plot(x, y, label=f"{label}, paper", **dot_style(look) | _RINGS)
    return panel.figure


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
    columns = 2 if (len(maps), len(delays)) == (4, 1) else min(len(maps), 3)
    # the long name of the axis does not fit three columns
    x_axis = FREQUENCY_ERROR if columns < 3 else SHORT_FREQUENCY_ERROR
    heights = [2.3] * (len(delays) * len(maps))
    with drawing(heights, columns=columns, axes=axes) as panels:
        drawn, grids = [(row, *named) for row in range(len(delays)) for named in maps.items()], []
        for panel, (row, name, grid) in zip(panels, drawn, strict=True):
            late = f", delay error {delays[row]:+g} frames" if np.any(delays) else ""
            name_axes(panel, x_axis, SENSOR_GAIN, f"{name}{late}")
            panel.locator_params(axis="y", nbins=4)  # whatever height the layout leaves
            across, up = np.argsort(grid.errors_hz), np.argsort(grid.sensor_gains)
            x, y = grid.errors_hz[across], grid.sensor_gains[up]
            grids.append((x, y, 100 * grid.strehl[row][np.ix_(up, across)]))
        label = f"{STREHL[0]} [{STREHL[1]}]"
        draw_map(panels, grids, label, blank="unstable loop")
        for panel, (x, y, values) in zip(panels, grids, strict=True):
            finite = values[np.isfinite(values)]
            if min(values.shape) > 1 and finite.size and np.ptp(finite) > 0:
                dark_on_light = {"cmap": "gray_r", "norm": panel.collections[0].norm}
                style = {**dark_on_light, "linewidths": 0.8}
                lines = panel.contour(x, y, np.ma.masked_invalid(values), 6, **style)
                panel.clabel(lines, fmt="%g", fontsize=7)
            if real_gain is not None and y[0] <= real_gain <= y[-1]:
                panel.axhline(real_gain, label="real sensor gain", linestyle="--", **GUIDE)
    return panels[0].figure


def limits_figure(study: LimitStudy, *, over_errors: bool = False) -> Figure:
    """Draw the residual of each design over the vibration's frequency or its error, and the limits.

    Unstable designs are named and not drawn. ProblemError if no vibration moves.
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
        start_hz, x_axis = study.frequency_hz or 0.0, (label, "Hz")
    order, places = np.argsort(study.shift_hz), np.sort(study.shift_hz) + start_hz
    curves: dict[str, FloatArray | None] = {}  # one for designs that leave the same
    for row, curve in zip(study.rows, study.residual_nm, strict=True):
        name, drawn = row.design if over_errors else design_label(row.design), list(curves.items())
        if row.stable:
            alike = [n for n, c in drawn if c is not None and np.allclose(c, curve, rtol=1e-6)]
            curves = {n: c for n, c in drawn if n not in alike}
            name = ", ".join([*alike, name])
        curves[name] = curve if row.stable else None
    with drawing([2.5]) as (panel,):
        _, factor = name_axes(panel, x_axis, ("residual", "nm rms"), yscale="log")
        for name, residual_nm in curves.items():
            shown = None if residual_nm is None else factor * residual_nm[order]
            draw_design(panel, [*curves], name, places, shown)
        for label, limit, style in (
            ("limit, frequency known", study.limit, ":"),
            ("limit, frequency anywhere in this range", study.band, "--"),
        ):
            if limit is not None and limit.rms_nm > 0:
                panel.axhline(factor * limit.rms_nm, label=label, linestyle=style, **GUIDE)
                panel.set_ylim(bottom=min(panel.get_ylim()[0], 0.9 * factor * limit.rms_nm))
    return panel.figure


def frame_rate_figure(rates_hz: ArrayLike, residuals_nm: Mapping[str, FloatArray]) -> Figure:
    """Draw residuals over the frame rate, by the names of designs and of the limit."""
    with drawing([2.5]) as (panel,):
        residual = ("residual", "nm rms")
        _, factor = name_axes(panel, ("frame rate", "Hz"), residual, xscale="log", yscale="log")
        for name, rms_nm in residuals_nm.items():
            label = design_label(name)
            draw_design(panel, [*map(design_label, residuals_nm)], label, rates_hz, factor * rms_nm)
    return panel.figure


_NAMES = dict(
    zip(FAMILIES, ("least variance at this norm", "central H∞ filter of this norm"), strict=True)
)


def tradeoff_figure(points: Sequence[Facts]) -> Figure:
    """Draw deviation and stable sensor gains over the norm of the estimation error.

    Above, the standard deviation; below, if there are loops, the interval of sensor gains for which
    each is stable. An end of it that is 0 has no line: the shaded area goes on to the edge. Norms
    that no filter reaches are shaded.
    """
    loops = any(point.design.hardware is not None for point in points)
    unit = "nm" if loops else "-"
    norms = [point.gamma for point in points]
    margin = 0.06 * (max(norms) - min(norms)) or 0.01 * max(norms)
    norm = ("H∞ norm of the estimation error", unit)
    with drawing([2.3] * (1 + loops)) as panels:
        _, factor = name_axes(panels[0], norm, ("estimation error, rms", unit))
        ends = [end for p in points for end in (p.gain_low, p.gain_high) if 0 < end < np.inf]
        edges = min([1.0, *ends]) / 2, 2 * max([1.0, *ends])
        if loops:
            shown_gains = ("sensor gains with a stable loop", "-")
            name_axes(panels[1], norm, shown_gains, yscale="log", ylim=edges)
        for look, family in enumerate(dict.fromkeys(point.family for point in points)):
            entries = sorted((p for p in points if p.family == family), key=lambda p: p.gamma)
            gamma, name = factor * np.array([p.gamma for p in entries]), _NAMES.get(family, family)
            rms = factor * np.array([p.rms for p in entries])
            panels[0].plot(gamma, rms, label=name, **dot_style(look))
            if not loops:
                continue
            interval = np.array([(p.gain_low, p.gain_high) for p in entries]).T
            panels[1].fill_between(gamma, *np.clip(interval, *edges), color=colour(look), **SHADE)
            for gains in interval:
                inside = np.where((gains > 0) & (gains < np.inf), gains, np.nan)
                panels[1].plot(gamma, inside, label=name, **dot_style(look))
        least = factor * min(point.rms for point in points)
        panels[0].plot(factor * max(norms), least, "o", label="Kalman", color="black", **_RINGS)
        if loops:
            panels[1].axhline(1.0, label="nominal sensor gain", linestyle="--", **GUIDE)
        low, high = factor * (min(norms) - margin), factor * (max(norms) + margin)
        for panel in panels:
            panel.axvspan(low, factor * min(norms), label="no filter", color="0.3", **SHADE)
            panel.set_xlim(low, high)
    return panels[0].figure


def modal_figure(
    residuals_nm: Mapping[str, FloatArray], *, gains: FloatArray, turbulence_nm: FloatArray
) -> Figure:
    """Draw the integrator gain of each mode, and its residual under several controllers."""
    count = gains.size
    modes, mode = np.arange(1.0, count + 1), ("mode, in Noll's order from tip on", "")
    # modes are counted, there is nothing between them
    step: dict[str, Any] = {"drawstyle": "steps-mid"}
    scale: dict[str, Any] = {"xscale": "log", "xlim": (1, max(count, 2))}
    with drawing([1.7, 2.6]) as (above, below):
        look = line_style(len(residuals_nm), dash=0, **step)  # of none of the residuals
        name_axes(above, mode, ("integrator gain", ""), **scale)
        above.plot(modes, gains, label="_integrator gain", **look)
        above.set_ylim(bottom=0)
        _, factor = name_axes(below, mode, ("residual", "nm rms"), yscale="log", **scale)
        grey = line_style(None, linewidth=1.0, **step)
        below.plot(modes, factor * turbulence_nm, label="turbulence", **grey)
        for name, rms_nm in residuals_nm.items():
            draw_design(below, list(residuals_nm), name, modes, factor * rms_nm, **step)
    return above.figure


def mirror_figure(shell: PositionLoop, hardware: LoopHardware, *, tolerance: float = 0.1) -> Figure:
    """Draw the mirror's step response, and its taps.

    The step response has the ends of the frames after the command's arrival, and the band in which
    the mirror counts as settled. The taps are the weights of the commands in the position averaged
    over an exposure, with those of a settled mirror beside them.
    """
    step = shell.step_response(tolerance)
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
    with drawing([2.4, 2.4], columns=2) as (response, weights):
        time = ("time since the command arrived", "ms")
        name_axes(response, time, ("position / final position", ""), xlim=(0, end_ms))
        response.axhspan(1 - tolerance, 1 + tolerance, color="0.3", **SHADE)
        response.plot(time_ms[shown], position[shown], label="this mirror", **line_style(0))
        for k in range(1, int(end_ms / frame_ms) + 1):
            response.axvline(k * frame_ms, label="frames", linestyle=":", **GUIDE)
        settled = f"settled to {100 * tolerance:g} %: {settling_ms:.2f} ms"
        response.axvline(settling_ms, label=settled, linestyle="--", **GUIDE)
        name_axes(weights, ("frames after the command", ""), ("weight in the exposure", ""))
        for name, values, look in (("settled at once", ideal, None), ("this mirror", taps, 0)):
            heights = np.zeros(count)
            heights[: values.size] = values[:count]
            style = line_style(look, drawstyle="steps-mid")
            weights.plot(np.arange(count), heights, label=name, **style)
        weights.set_xlim(-0.6, count - 0.4)
    return response.figure


_SHOWN_MAS = 700.0  # from the centre of the image to its edges
_FAINTEST = 1e-5  # of the peak


def end_to_end_figure(run: EndToEndRun) -> Figure:
    """Image, tip and tilt over time, and residual of each mode of an end-to-end run."""
    size = run.psf.shape[0]
    position_mas = (np.arange(size) - size // 2) * run.psf_pixel_mas
    reach_mas = min(_SHOWN_MAS, size / 2 * run.psf_pixel_mas)
    seconds = np.arange(run.frames) / run.setup.hardware.frame_rate_hz
    with drawing([2.4, 2.4, PANEL_IN], columns=2) as (image, modes, series):
        title = f"{run.setup.imaging_wavelength_um:g} µm, Strehl ratio {100 * run.strehl:.1f} %"
        name_axes(image, ("x", "mas"), ("y", "mas"), title, box_aspect=1)
        values = np.maximum(run.psf / run.psf.max(), _FAINTEST)
        draw_map([image], [(position_mas, position_mas, values)], "intensity / peak", log=True)
        image.set(xlim=(-reach_mas, reach_mas), ylim=(-reach_mas, reach_mas))
        mode, residual = ("mode (1 tip, 2 tilt)", ""), ("residual", "nm rms")
        with own_display_unit():  # most modes are no tilt
            name_axes(modes, mode, residual, "all modes", xscale="log", yscale="log")
        numbers = np.arange(1.0, run.setup.modes + 1)
        thin = line_style(0, linewidth=0.8)
        modes.plot(numbers, run.rms_nm, label="_residual", **thin)
        _, factor = name_axes(series, ("time", "s"), residual, "tip and tilt")
        for axis, name in enumerate(("tip", "tilt")):
            label = f"{name}, {nm_text(run.rms_nm[axis], '.0f', unit='nm rms')}"
            style = line_style(axis, dash=0, linewidth=0.8)
            series.plot(seconds, factor * run.residual_nm[:, axis], label=label, **style)
    return image.figure


def end_to_end_table_figure(entries: Sequence[Facts]) -> Figure:
    """Strehl ratios of Table III by end-to-end simulation, the modal analysis and the paper."""
    rows = [e for e in entries if e.table == "III" and e.error_hz is not None]
    methods = list(dict.fromkeys(e.method for e in rows))
    x_axis = FREQUENCY_ERROR if len(methods) < 3 else SHORT_FREQUENCY_ERROR
    y_axis = ("Strehl ratio at 2.2 µm", "%")
    with drawing([2.3] * len(methods), columns=len(methods)) as panels:
        for panel, method in zip(panels, methods, strict=True):
            name_axes(panel, x_axis, y_axis, design_label(method), ylim=(0, 100))
            names = ("error_hz", "paper", "modal", "strehl", "scatter")
            entries = [e for e in rows if e.method == method]
            error, paper, modal, strehl, scatter = (
                np.array([getattr(e, name) for e in entries], dtype=float) for name in names
            )
            if not np.isnan(paper[0]):  # it published none of its own integrator
                panel.plot(error, paper, label="Agapito et al. 2008", **dot_style(3))
            panel.plot(error, modal, label="modal, measured optical gain", **line_style(1))
            panel.vlines(error, strehl - scatter, strehl + scatter, color=colour(0))
            panel.plot(error, strehl, label="end to end", **dot_style(0))
    return panels[0].figure
