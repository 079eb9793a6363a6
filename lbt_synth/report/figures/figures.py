"""Figures that an engineer would put in a paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.design import Design, EstimatorDesign
from lbt_synth.errors import ProblemError
from lbt_synth.linear import largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import ClosedLoop, Simulation, close_loop
from lbt_synth.models import TipTiltPlant
from lbt_synth.report.figures.style import MARKERS, house_style, looks, new_figure, plain_ticks
from lbt_synth.studies import RobustnessRow
from lbt_synth.validation import FloatArray

_POINTS = 1200


def frequency_grid(
    rate_hz: float, special_hz: Sequence[float] = (), *, decades: float = 3.6
) -> FloatArray:
    """Logarithmic grid up to Nyquist, denser around special frequencies."""
    nyquist = rate_hz / 2
    grids = [np.geomspace(nyquist / 10**decades, nyquist, _POINTS)]
    for centre in special_hz:
        spread = np.geomspace(1e-4, 0.2, 60)
        grids += [centre * (1 + spread), centre * (1 - spread), np.array([centre])]
    grid = np.unique(np.concatenate(grids))
    return grid[(grid > 0) & (grid <= nyquist)]


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
        One panel a transfer function, the vibration frequencies marked. A loop that is
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
    styles = dict(zip(designs, looks(), strict=False))
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
            _loop_panels(rejection, next(remaining), loops, styles, lines_hz)
        for axis in axes:
            _mark(axis, lines_hz)
            plain_ticks(axis)
            axis.legend(loc="best")
        axes[-1].set_xlabel("frequency [Hz]")
    return figure


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
        _loop_panels(top, bottom, loops, dict(zip(loops, looks(), strict=False)), [])
        top.legend(loc="best")
        bottom.legend(loc="best")
        bottom.set_xlabel("frequency [Hz]")
    return figure


def _loop_panels(
    rejection: Any,
    noise: Any,
    loops: Mapping[str, ClosedLoop],
    styles: Mapping[str, dict[str, Any]],
    lines_hz: Sequence[float],
) -> None:
    for name, loop in loops.items():
        if not loop.is_stable:  # it has no steady response: named in the legend, not drawn
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


def robustness_figure(
    rows: Sequence[RobustnessRow],
    published: Mapping[str, Sequence[tuple[float, float]]] | None = None,
) -> Any:
    """Strehl ratio over the error of the model's vibration frequency.

    Parameters
    ----------
    rows : sequence of RobustnessRow
        Rows of :func:`frequency_robustness`.
    published : mapping, optional
        For each method, pairs (error [Hz], Strehl ratio [%]) drawn as open markers.

    Returns
    -------
    matplotlib.figure.Figure
        One panel; unstable rows are left out of the line and marked at the bottom.

    Raises
    ------
    ProblemError
        If there are no rows.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> row = lbt.studies.RobustnessRow(
    ...     error_hz=0.0,
    ...     method="kalman",
    ...     strehl=0.8,
    ...     residual_nm=40.0,
    ...     vibration_nm=10.0,
    ...     turbulence_nm=20.0,
    ...     noise_nm=30.0,
    ...     stable=True,
    ...     gamma=190.0,
    ... )
    >>> len(lbt.report.figures.robustness_figure([row]).axes)
    1
    """
    if not rows:
        raise ProblemError("a robustness figure needs at least one row; got none.")
    names = {"kalman": "Kalman", "hinf": r"H$_\infty$"}
    methods = list(dict.fromkeys(row.method for row in rows))
    with house_style():
        figure = new_figure(6.3, 3.8)
        axis = figure.subplots()
        for method, style, marker in zip(methods, looks(), MARKERS, strict=False):
            own = sorted((r for r in rows if r.method == method), key=lambda r: r.error_hz)
            label = names.get(method, method)
            axis.plot(
                [r.error_hz for r in own],
                [100 * r.strehl for r in own],
                marker=marker,
                markersize=4,
                label=label if any(r.stable for r in own) else None,
                **style,
            )
            unstable = [r.error_hz for r in own if not r.stable]
            if unstable:
                axis.plot(
                    unstable,
                    [0.0] * len(unstable),
                    linestyle="none",
                    marker="x",
                    clip_on=False,
                    color=style["color"],
                    label=f"{label}: unstable",
                )
            if published is not None and method in published:
                errors, values = zip(*published[method], strict=True)
                axis.plot(
                    errors,
                    values,
                    linestyle="none",
                    marker=marker,
                    markersize=7,
                    markerfacecolor="none",
                    markeredgecolor=style["color"],
                    label=f"{label}, paper",
                )
        axis.set_xlabel("error of the vibration frequency in the model [Hz]")
        axis.set_ylabel("Strehl ratio [%]")
        axis.set_ylim(0, 1.06 * axis.get_ylim()[1])
        axis.legend(loc="best")
    return figure


def simulation_figure(run: Simulation, *, title: str = "") -> Any:
    """Residual series and spectra before and after the correction.

    Parameters
    ----------
    run : Simulation
        A run; its first case is drawn, the spectra are means over all cases.
    title : str, optional
        Title of the figure.

    Returns
    -------
    matplotlib.figure.Figure
        Series above, spectra below.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> run = lbt.simulate(
    ...     lazy.controller, lbt.Truth(turbulence=None, noise_nm=5.0), hardware=path, frames=512
    ... )
    >>> len(lbt.report.figures.simulation_figure(run).axes)
    2
    """
    from scipy.signal import welch

    axes_names = ("tip", "tilt")
    n = run.residual_nm.shape[2]
    names = axes_names if n <= len(axes_names) else [f"mode {i}" for i in range(n)]
    frames = run.residual_nm.shape[1]
    with house_style():
        figure = new_figure(6.3, 5.2)
        series, spectrum = figure.subplots(2, 1)
        time = np.arange(frames) / run.frame_rate_hz
        length = min(frames, 2048)
        for i, style in zip(range(n), looks(), strict=False):
            series.plot(
                time,
                run.residual_nm[0, :, i],
                label=names[i],
                linewidth=0.6,
                alpha=0.8,
                color=style["color"],
            )
            for data, word, line in (
                (run.total_nm, "open loop", ":"),
                (run.residual_nm, "residual", "-"),
            ):
                f, s = welch(data[:, :, i], fs=run.frame_rate_hz, nperseg=length, axis=1)
                mean = np.maximum(s.mean(axis=0)[1:], 1e-12)
                spectrum.loglog(
                    f[1:],
                    mean,
                    linestyle=line,
                    color=style["color"],
                    label=f"{names[i]}, {word}",
                    linewidth=1.0,
                )
        series.set_xlabel("time [s]")
        series.set_ylabel("residual [nm rms wavefront]")
        series.legend(loc="upper right")
        spectrum.set_xlabel("frequency [Hz]")
        spectrum.set_ylabel(r"power spectrum [nm$^2$/Hz]")
        spectrum.legend(loc="best", ncols=2)
        if title:
            figure.suptitle(title, fontsize=10)
    return figure


def _vibration_frequencies(designs: Any) -> list[float]:
    found = {
        line.frequency_hz
        for design in designs
        if isinstance(design, EstimatorDesign) and isinstance(design.problem, TipTiltPlant)
        for line in design.problem.vibrations
    }
    return sorted(found)


def _mark(axis: Any, lines_hz: Sequence[float]) -> None:
    for i, frequency in enumerate(lines_hz):
        axis.axvline(
            frequency,
            color="0.35",
            linestyle=":",
            linewidth=1.0,
            label="vibration" if i == 0 else None,
            zorder=0,
        )
