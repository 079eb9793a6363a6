"""Views of loops: singular values, Bode, Nyquist and Nichols plots, and step responses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import ClosedLoop, close_loop, loop_margins
from lbt_synth.loop.margins import BrokenLoop, broken_loops
from lbt_synth.loop.simulation import SHOWN_FRAMES, LoopStep, step_response
from lbt_synth.report.draw import (
    GREY,
    GUIDE,
    PANEL_IN,
    Figure,
    OwnAxes,
    drawing,
    line_style,
    name_axes,
    shorten,
)
from lbt_synth.validation import ComplexArray, FloatArray, choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FREQUENCY = ("frequency", "Hz")
_DECADES = 3.6  # of frequency that are drawn, below half the frame rate
_POINTS = 1200  # of a grid of frequencies
_LOWEST_DB, _HIGHEST_DB = -40.0, 60.0
_REACH = 2.5  # of a Nyquist plot from its centre
_MODULI = (0.3, 0.5, 0.7)  # modulus margins whose contours a Nichols plot has
_TURN = np.linspace(0, 2 * np.pi, 241)
_APART = 1e-12  # of a response, that another axis has by rounding
_MARKS = {"phase margin": "o", "gain margin": "s", "critical point": "x"}
Loops: TypeAlias = Mapping[str, ClosedLoop]  # by the names of designs
# Frequencies [Hz] of a curve, (f,), and the largest singular values of error, rejection and noise,
# (f,) each; None for what there is not
SigmaCurves: TypeAlias = tuple[FloatArray, FloatArray | None, FloatArray | None, FloatArray | None]
# Name of a broken loop, its look, its dash (None for the first axis of a design), and the loop
# itself; None where it is unstable
OpenLoop: TypeAlias = tuple[str, int, int | None, BrokenLoop | None]


def loop_figure(
    designs: Mapping[str, Design],
    kind: str,
    *,
    sensor_gain: float = 1.0,
    unit_weights: bool = False,
    axes: OwnAxes = None,
) -> Figure:
    """Draw a view of the loops of designs.

    Loops are broken at each measurement in turn, the others closed; axes that respond alike are one
    curve. A loop that is unstable is named and not drawn.

    Parameters
    ----------
    designs : mapping of str to Design
        Designs by the name they get in the legend. Each needs a loop, but for ``"sigma"``.
    kind : {"sigma", "bode", "nyquist", "nichols", "step"}
        ``"sigma"``: largest singular values of the estimation error, the rejection and the noise
        transfer, a panel each, the vibration frequencies marked; axes that do not mix have a curve
        each. ``"bode"``: gain and phase over frequency, with the margins; the phase has no jumps
        and includes the delay. ``"nyquist"``: the complex plane, a panel for each design, with the
        circles of the modulus and of the disk margin, which no loop enters. ``"nichols"``: gain
        over phase; a loop outside a contour has its modulus margin. ``"step"``: residual and
        command after a step of the wavefront, in two panels.
    sensor_gain : float, optional
        Real sensor gain, relative to the one of each design.
    unit_weights : bool, optional
        Draw the estimation error against disturbances of unit size, as Agapito et al. (2008) do,
        instead of the weighted ones of each design.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        The figure.

    Raises
    ------
    ProblemError
        If there is no design or no such view, a design has no loop, or ``axes`` do not fit.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4)
    >>> len(lbt.report.figures.loop_figure({"slow": slow}, "bode").axes)
    2
    """
    choice(kind, "kind", ("sigma", *DRAWN))
    loops = closed_loops(designs, sensor_gain, needed=kind != "sigma")
    if kind != "sigma":
        return DRAWN[kind](loops, axes=axes)
    curves = sigma_curves(designs, loops, unit_weights=unit_weights)
    estimators = [design for design in designs.values() if design.is_estimator]
    physical = all(design.hardware is not None for design in estimators)
    factor = "" if sensor_gain == 1 else f" at {sensor_gain:g} times the sensor gain"
    return draw_sigma(
        curves,
        loops,
        _vibrations_hz(designs),
        unit="nm" if physical and not unit_weights else "-",
        title=f"closed loops{factor}",
        axes=axes,
    )


def closed_loops(
    designs: Mapping[str, Design], sensor_gain: float, *, needed: bool = True
) -> dict[str, ClosedLoop]:
    """Close the loop of each design; one without a loop is refused where it is needed."""
    if not designs:
        raise ProblemError("a plot of loops needs at least one design; got none.")
    loops = {}
    for name, design in designs.items():
        if design.hardware is not None:
            loops[name] = close_loop(design.hardware, design.controller, sensor_gain=sensor_gain)
        elif needed:
            raise ProblemError(
                f"{name} is a filter of a bare estimation problem; expected a design for a loop."
            )
    return loops


def frequency_grid(
    rate_hz: float, special_hz: Sequence[float] = (), *, points: int = _POINTS, near: int = 60
) -> FloatArray:
    """Logarithmic grid below Nyquist, denser around special frequencies and towards Nyquist.

    It has so many points, and so many more near each special one, on either side of it. Nyquist
    itself is left out: a zero there is no scale.
    """
    nyquist = rate_hz / 2
    grids = [np.geomspace(nyquist / 10**_DECADES, nyquist, points)]
    for centre in (*special_hz, nyquist):
        spread = np.geomspace(1e-4, 0.2, near)
        grids += [centre * (1 + spread), centre * (1 - spread), np.array([centre])]
    grid = np.unique(np.concatenate(grids))
    return grid[(grid > 0) & (grid < nyquist)]


def draw_design(
    axes: Axes, names: Sequence[str], name: str, x: ArrayLike, y: ArrayLike | None, **style: Any
) -> None:
    """Draw the curve of a design in the look of its place among the names.

    Without values it is in the legend as unstable.
    """
    look = line_style(list(names).index(name))
    if y is None:
        axes.plot([], [], label=f"{name}: unstable", **look)
    else:
        axes.plot(x, y, label=name, **look, **style)


def sigma_curves(
    designs: Mapping[str, Design],
    loops: Loops,
    *,
    unit_weights: bool = False,
    lines_hz: Sequence[float] | None = None,
) -> dict[str, SigmaCurves]:
    """Return frequencies [Hz] and values of error, rejection and noise by the names of curves.

    They are largest singular values. Axes that do not mix have a curve each, unless they are equal:
    the largest of both would be that of the other axis at a line of one. Frequencies are dense
    around lines, by default the vibrations of the designs.
    """
    lines_hz = _vibrations_hz(designs) if lines_hz is None else lines_hz
    curves: dict[str, SigmaCurves] = {}
    for name, design in designs.items():
        grid, error = frequency_grid(1 / design.controller.dt_s, lines_hz), None
        rejection = noise = None
        if design.is_estimator:
            system = design.error_system()
            if unit_weights:
                gain = design.arrays()["gain_predictor"]
                system = design.problem.with_unit_weights().error_system(gain)
            error = spectral_norms(system.frequency_response(grid))
        if name in loops and loops[name].is_stable:
            S, N = (
                loops[name].sensitivity(grid),
                loops[name].path("noise", "residual").frequency_response(grid),
            )
            diagonals = [np.abs(response.diagonal(axis1=1, axis2=2)).T for response in (S, N)]
            if _are_apart(S) and _are_apart(N) and not np.allclose(diagonals[0], diagonals[0][0]):
                for axis, pair in enumerate(zip(*diagonals, strict=True)):
                    curves[axes_name(name, [axis], alone=False)] = grid, None, *pair
                if error is not None:
                    curves[name] = grid, error, None, None
                continue
            rejection, noise = spectral_norms(S), spectral_norms(N)
        curves[name] = grid, error, rejection, noise
    return curves


def _are_apart(response: ComplexArray) -> bool:
    """Whether a response (f, n, n) is diagonal, but for rounding."""
    if response.shape[1] != response.shape[2]:
        return False
    others = np.abs(response[:, ~np.eye(response.shape[1], dtype=np.bool_)])
    return bool(np.max(others, initial=0.0) <= _APART * np.max(np.abs(response)))


def _vibrations_hz(designs: Mapping[str, Design]) -> list[float]:
    """Return the frequencies of the vibrations that designs assume."""
    plants = [design.plant for design in designs.values() if design.is_estimator]
    return sorted({v.frequency_hz for plant in plants if plant for v in plant.vibrations})


def draw_sigma(
    curves: Mapping[str, SigmaCurves],
    loops: Loops,
    lines_hz: Sequence[float],
    *,
    unit: str = "nm",
    title: str = "",
    axes: OwnAxes = None,
) -> Figure:
    """Draw estimation errors, and rejection and noise transfer of loops; a panel for what is there.

    The unit is that of the errors, the title that of the loops.
    """
    parts = [
        ("disturbances to error", unit),
        ("phase to residual", "-"),
        ("noise to residual", "-"),
    ]
    drawn = [
        (number, label, of, {name: (f, y[number]) for name, (f, *y) in curves.items()})
        for number, (label, of) in enumerate(parts)
        if (number and loops) or any(y[number] is not None for _, *y in curves.values())
    ]
    with drawing([PANEL_IN] * len(drawn), axes=axes) as panels:
        for panel, (number, label, of, norms) in zip(panels, drawn, strict=True):
            y_axis, above = (f"\u03c3\u0304, {label}", of), title if number == 1 else ""
            _, factor = name_axes(panel, FREQUENCY, y_axis, above, xscale="log", yscale="log")
            for name, (f, norm) in norms.items():
                is_unstable = number > 0 and name in loops and not loops[name].is_stable
                if norm is not None or is_unstable:
                    shown = None if norm is None else factor * norm
                    draw_design(panel, list(norms), name, f, shown)
            for line_hz in lines_hz:
                panel.axvline(line_hz, label="vibration", linestyle=":", **GUIDE)
            if number == 1:
                panel.axhline(1.0, **GUIDE)
    return panels[0].figure


def axes_name(design: str, measurements: Sequence[int], *, alone: bool) -> str:
    """Name the axes of a design; those of one that has only equal ones are the design."""
    if alone:
        return design
    numbers = " and ".join(str(index + 1) for index in measurements)
    return f"{design}, {'axis' if len(measurements) == 1 else 'axes'} {numbers}"


def open_loops(loops: Loops) -> list[OpenLoop]:
    """Break the loops of designs at each measurement, the others closed; equal axes are one."""
    opened: list[OpenLoop] = []
    for look, (design, loop) in enumerate(loops.items()):
        groups = broken_loops(loop) if loop.is_stable else (None,)
        for number, broken in enumerate(groups):
            measurements = () if broken is None else broken.measurements
            name = axes_name(design, measurements, alone=len(groups) == 1)
            opened.append((name, look, look + number if number else None, broken))
    return opened


def loop_points(broken: BrokenLoop) -> tuple[FloatArray, FloatArray, FloatArray, ComplexArray]:
    """Frequency [Hz], gain [dB], phase [deg] and response where a curve is drawn, (f,) each."""
    shown = broken.frequency_hz >= broken.frequency_hz[-1] / 10**_DECADES
    f, gain, phase = broken.frequency_hz, broken.gain_db, broken.phase_deg
    return f[shown], gain[shown], phase[shown], broken.response[shown]


def margins_text(broken: BrokenLoop | None) -> str:
    """Phase and gain margins of a broken loop as text."""
    if broken is None:
        return "unstable"
    point = broken.phase_margin
    texts = [] if point is None else [f"{point.phase_deg:.1f}° at {point.frequency_hz:.3g} Hz"]
    gains = [f"{20 * np.log10(point.gain):+.1f}" for point in broken.gain_margins]
    return ", ".join(texts + ([f"{' / '.join(gains)} dB"] if gains else []))


def _draw_opened(axes: Axes, opened: OpenLoop, x: ArrayLike, y: ArrayLike) -> None:
    """Draw a curve in the look of a loop, named with its margins."""
    name, look, dash, broken = opened
    label = f"{shorten(name, 24)}: {margins_text(broken)}"
    axes.plot(x, y, label=label, **line_style(look, dash=dash))


def _margin_points(broken: BrokenLoop | None) -> Iterator[tuple[str, float, float, float]]:
    """Yield name, frequency [Hz], gain [dB] and phase [deg] of the points that margins lie at."""
    if broken is None:
        return
    if (point := broken.phase_margin) is not None:
        yield "phase margin", point.frequency_hz, 0.0, _phase_at(broken, point.frequency_hz)
    for point in broken.gain_margins:
        # a margin at rest is drawn at the lowest frequency
        frequency_hz = max(point.frequency_hz, broken.frequency_hz[-1] / 10**_DECADES)
        gain_db = -20 * float(np.log10(point.gain))
        yield "gain margin", frequency_hz, gain_db, _phase_at(broken, frequency_hz)


def _phase_at(broken: BrokenLoop, frequency_hz: float) -> float:
    return float(np.interp(frequency_hz, broken.frequency_hz, broken.phase_deg))


def _mark(axes: Axes, name: str, x: float, y: float) -> None:
    """Draw the mark of a margin or of the critical point."""
    axes.plot(x, y, _MARKS[name], label=name, color=GREY, markersize=4.5)


def draw_bode(loops: Loops, *, axes: OwnAxes = None) -> Figure:
    """Draw gain and phase of broken loops, with their margins."""
    opened = open_loops(loops)
    with drawing([PANEL_IN, PANEL_IN], axes=axes) as (above, below):
        name_axes(above, FREQUENCY, ("loop gain", "dB"), xscale="log")
        name_axes(below, FREQUENCY, ("phase", "deg"), xscale="log")
        above.axhline(0.0, linestyle="--", **GUIDE)
        for loop in opened:
            broken = loop[-1]
            if broken is None:
                _draw_opened(above, loop, [], [])
                continue
            f, gain, phase, _ = loop_points(broken)
            _draw_opened(above, loop, f, np.maximum(gain, 2 * _LOWEST_DB))  # a zero is far below
            _draw_opened(below, loop, f, phase)
            for name, frequency_hz, gain_db, phase_deg in _margin_points(broken):
                if name == "gain margin":
                    _mark(above, name, frequency_hz, gain_db)
                else:
                    _mark(below, name, frequency_hz, phase_deg)
        low, high = above.get_ylim()
        above.set_ylim(max(low, _LOWEST_DB), min(high, _HIGHEST_DB))
        for at in _critical_phases(*below.get_ylim()):
            below.axhline(at, linestyle="--", **GUIDE)
    return above.figure


def _draw_nyquist(loops: Loops, *, axes: OwnAxes = None) -> Figure:
    """Draw broken loops in the complex plane, with the disks that they keep out of."""
    columns = min(2, len(loops))
    square_in = min(7.0 / columns - 0.75, 5.0)  # height of square axes, so many side by side
    with drawing([square_in] * len(loops), columns=columns, axes=axes) as panels:
        for panel, (name, loop) in zip(panels, loops.items(), strict=True):
            margins = loop_margins(loop) if loop.is_stable else None
            title = f"{name}: unstable"
            if margins is not None:
                title = f"{name}: disk {margins.disk:.2f}, modulus {margins.modulus:.2f}"
            parts = ("real part", "-"), ("imaginary part", "-")
            name_axes(panel, *parts, title, box_aspect=1)
            panel.set(xlim=(-1.4 * _REACH, 0.6 * _REACH), ylim=(-_REACH, _REACH))
            panel.plot(np.cos(_TURN), np.sin(_TURN), label="unit circle", linestyle=":", **GUIDE)
            _mark(panel, "critical point", -1.0, 0.0)
            if margins is None:
                continue
            groups = broken_loops(loop)
            for number, broken in enumerate(groups):
                far = np.abs(broken.response) > 3 * _REACH
                shown = np.where(far, np.nan, broken.response)
                label = axes_name("loop", broken.measurements, alone=len(groups) == 1)
                panel.plot(shown.real, shown.imag, label=label, **line_style(0, dash=number))
                if (point := broken.phase_margin) is not None:
                    _mark(panel, "phase margin", point.response.real, point.response.imag)
                for point in broken.gain_margins:
                    _mark(panel, "gain margin", point.response.real, 0.0)
            low, high = margins.disk_gain_low, min(margins.disk_gain_high, 1e3)
            for label, centre, radius, look in (
                ("modulus margin", -1.0, margins.modulus, 2),
                ("disk margin", -(low + high) / 2, (high - low) / 2, 1),
            ):
                x, y = centre + radius * np.cos(_TURN), radius * np.sin(_TURN)
                panel.plot(x, y, label=label, **GUIDE | line_style(look, dash=0))
    return panels[0].figure


def _draw_nichols(loops: Loops, *, axes: OwnAxes = None) -> Figure:
    """Draw gain over phase of loops, with their margins and contours of the modulus margin."""
    opened = open_loops(loops)
    with drawing([2 * PANEL_IN], axes=axes) as (panel,):
        name_axes(panel, ("phase", "deg"), ("loop gain", "dB"))
        for loop in opened:
            broken = loop[-1]
            gain, phase = (np.zeros(0),) * 2 if broken is None else loop_points(broken)[1:3]
            seen = (gain > _LOWEST_DB) & (gain < _HIGHEST_DB)
            _draw_opened(panel, loop, np.where(seen, phase, np.nan), np.where(seen, gain, np.nan))
            for name, _, gain_db, phase_deg in _margin_points(broken):
                _mark(panel, name, phase_deg, gain_db)
        ends = panel.get_xlim()
        ends = min(ends[0], -360.0), max(ends[1], 0.0)
        for at in _critical_phases(*ends):
            for dash, modulus in enumerate(_MODULI, start=1):
                point = 1 - modulus * np.exp(1j * _TURN)
                degrees, decibels = at + np.degrees(np.angle(point)), 20 * np.log10(np.abs(point))
                style = GUIDE | line_style(None, dash=dash)
                panel.plot(degrees, decibels, label=f"modulus {modulus:g}", **style)
            _mark(panel, "critical point", at, 0.0)
        panel.set(xlim=ends, ylim=(_LOWEST_DB, 40.0))
    return panel.figure


def _critical_phases(lowest: float, highest: float) -> list[float]:
    """Return the phases [deg] within a range at which a gain of one is -1."""
    first, last = np.ceil((lowest + 180) / 360), np.floor((highest + 180) / 360)
    return [float(360 * k - 180) for k in np.arange(first, last + 1)]


def design_steps(loops: Loops, *, frames: int = SHOWN_FRAMES) -> dict[str, list[LoopStep]]:
    """Return the step responses of designs; axes that respond alike are one."""
    steps: dict[str, list[LoopStep]] = {}
    for name, loop in loops.items():
        unlike: list[LoopStep] = []
        for axis in range(loop.hardware.modes if loop.is_stable else 0):
            step = step_response(loop, axis=axis, frames=frames)
            if not any(np.allclose(step.residual, other.residual) for other in unlike):
                unlike.append(step)
        steps[name] = unlike
    return steps


def draw_steps(loops: Loops, *, axes: OwnAxes = None) -> Figure:
    """Draw residual and command after a step, as parts of it."""
    steps = design_steps(loops)
    with drawing([PANEL_IN, PANEL_IN], axes=axes) as panels:
        for panel, label in zip(panels, ("residual", "command"), strict=True):
            time = ("time after the step", "ms")
            name_axes(panel, time, (f"{label}, part of the step", "-"))
            for look, (design, responses) in enumerate(steps.items()):
                if not responses:
                    draw_design(panel, list(steps), design, [], None)
                for number, step in enumerate(responses):
                    name = axes_name(design, [step.axis], alone=len(responses) == 1)
                    style = line_style(look, dash=look + number, drawstyle="steps-post")
                    panel.plot(1e3 * step.time_s, getattr(step, label), label=name, **style)
    return panels[0].figure


DRAWN: Mapping[str, Callable[..., Figure]] = {
    "bode": draw_bode,
    "nyquist": _draw_nyquist,
    "nichols": _draw_nichols,
    "step": draw_steps,
}
