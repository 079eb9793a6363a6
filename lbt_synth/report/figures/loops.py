"""Figures of loops: singular values, Bode, Nyquist and Nichols plots, and step responses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.linear import largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import ClosedLoop, broken_loops, close_loop, loop_margins, step_response
from lbt_synth.loop.broken_loops import BrokenLoop
from lbt_synth.loop.simulation.run import SHOWN_FRAMES, LoopStep
from lbt_synth.report.draw import PANEL_IN, Figure, OwnAxes, Panel, drawing, shorten, square_in
from lbt_synth.validation import ComplexArray, FloatArray

FREQUENCY = {"label": "frequency", "unit": "Hz", "log": True}
_DECADES = 3.6  # of frequency that are drawn, below half the frame rate
_DEEPEST = 1e5  # below the highest value: a zero at the Nyquist frequency is no scale
_POINTS = 1200  # of a grid of frequencies
_LOWEST_DB, _HIGHEST_DB = -40.0, 60.0
_REACH = 2.5  # of a Nyquist plot from its centre
_FAR = 8.0  # loop gain beyond which a Nyquist plot draws nothing
_MODULI = (0.3, 0.5, 0.7)  # modulus margins whose contours a Nichols plot has
_TURN = np.linspace(0, 2 * np.pi, 241)
_THIN: dict[str, Any] = {"look": None, "width": 1.0, "numbers": False}
# Frequencies [Hz], and the largest singular values of a design, (f,) each; None for what a design
# does not have, or where its loop is unstable
Norms: TypeAlias = tuple[FloatArray, FloatArray | None]
Steps: TypeAlias = Mapping[str, Sequence[LoopStep]]  # of each design; none in an unstable loop


def frequency_grid(
    rate_hz: float,
    special_hz: Sequence[float] = (),
    *,
    points: int = _POINTS,
    near: int = 60,
) -> FloatArray:
    """Logarithmic grid up to Nyquist, denser around special frequencies and below Nyquist.

    It has so many points, and so many more near each special one, on either side of it.
    """
    nyquist = rate_hz / 2
    grids = [np.geomspace(nyquist / 10**_DECADES, nyquist, points)]
    for centre in (*special_hz, nyquist):
        spread = np.geomspace(1e-4, 0.2, near)
        grids += [centre * (1 + spread), centre * (1 - spread), np.array([centre])]
    grid = np.unique(np.concatenate(grids))
    return grid[(grid > 0) & (grid <= nyquist)]


def draw_design(
    panel: Panel, names: Sequence[str], name: str, x: ArrayLike, y: ArrayLike | None, **look: Any
) -> None:
    """Draw the curve of a design in the look of its place among the names.

    Without values it is in the legend as unstable.
    """
    number = list(names).index(name)
    if y is None:
        panel.curve(f"{name}: unstable", [], [], look=number)
    else:
        panel.curve(name, x, y, look=number, **look)


def draw_transfer(
    panel: Panel,
    label: str,
    unit: str,
    norms: Mapping[str, Norms],
    names: Sequence[str],
    lines_hz: Sequence[float],
    *,
    title: str = "",
    line: str = "vibration",
) -> None:
    """Draw transfer functions over frequency, with the vibrations at lines_hz marked."""
    values = np.concatenate([np.zeros(1), *(y for _, y in norms.values() if y is not None)])
    floor = float(np.max(values)) / _DEEPEST
    low = floor if np.any(values[1:] < floor) and floor > 0 else None
    y_axis = {"label": f"\u03c3\u0304, {label}", "unit": unit, "log": True, "low": low}
    panel.set_axes(FREQUENCY, y_axis, title=title)
    for name, (frequency_hz, norm) in norms.items():
        draw_design(panel, names, name, frequency_hz, norm)
    for line_hz in lines_hz:
        panel.rule(line, line_hz, dash=3)


def draw_sigma(
    errors: Mapping[str, Norms],
    rejections: Mapping[str, Norms],
    noises: Mapping[str, Norms],
    names: Sequence[str],
    lines_hz: Sequence[float],
    *,
    unit: str = "nm",
    title: str = "",
    line: str = "vibration",
    axes: OwnAxes = None,
) -> Figure:
    """Draw estimation errors, and rejection and noise transfer of loops; a panel for what is there.

    The title is that of the loops.
    """
    parts = [
        ("disturbances to error", unit, errors, ""),
        ("phase to residual", "-", rejections, title),
        ("noise to residual", "-", noises, ""),
    ]
    parts = [part for part in parts if part[2]]
    with drawing([PANEL_IN] * len(parts), axes=axes) as panels:
        for panel, (label, of, norms, words) in zip(panels, parts, strict=True):
            draw_transfer(panel, label, of, norms, names, lines_hz, title=words, line=line)
            if norms is rejections:
                panel.rule("", 1.0, "y")
    return panels[0].figure


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
        unstable at this sensor gain is named and not drawn. Axes that do not mix have a curve each;
        of others the largest singular value is that of the worst direction.

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
    lines_hz = _vibration_frequencies(designs.values())
    norms = sigma_curves(designs, sensor_gain=sensor_gain, unit_weights=unit_weights)
    names = list(norms)
    errors = {name: (f, error) for name, (_, f, error, *_) in norms.items() if error is not None}
    split = {design for name, (design, *_) in norms.items() if name != design}
    closed = [
        name
        for name, (design, *_) in norms.items()
        if designs[design].hardware is not None and name not in split
    ]
    rejections = {name: (norms[name][1], norms[name][3]) for name in closed}
    noises = {name: (norms[name][1], norms[name][4]) for name in closed}
    physical = all(designs[name].hardware is not None for name in errors)
    unit = "nm" if physical and not unit_weights else "-"
    factor = "" if sensor_gain == 1 else f" at {sensor_gain:g} times the sensor gain"
    title = f"closed loops{factor}"
    more: dict[str, Any] = {"unit": unit, "title": title, "axes": axes}
    return draw_sigma(errors, rejections, noises, names, lines_hz, **more)


_APART = 1e-12  # of a response, that another axis has by rounding
_Curves: TypeAlias = tuple[str, FloatArray, FloatArray | None, FloatArray | None, FloatArray | None]


def sigma_curves(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, unit_weights: bool = False
) -> dict[str, _Curves]:
    """Return of each curve its design, frequencies [Hz], and values of error, rejection and noise.

    They are largest singular values. Axes that do not mix have a curve each, unless they are equal:
    the largest of both would be that of the other axis at a line of one. Frequencies are dense
    around vibrations.
    """
    lines_hz, curves = _vibration_frequencies(designs.values()), {}
    for name, design in designs.items():
        grid, error = frequency_grid(1 / design.controller.dt_s, lines_hz), None
        rejection = noise = None
        if design.is_estimator:
            problem = design.problem
            system = design.error_system(problem.with_unit_weights() if unit_weights else problem)
            error = largest_singular_values(system, grid)
        if design.hardware is not None:
            loop = close_loop(design.hardware, design.controller, sensor_gain=sensor_gain)
            if loop.is_stable:
                S, N = loop.sensitivity(grid), loop.noise_transfer(grid)
                axes = [np.abs(part.diagonal(axis1=1, axis2=2)).T for part in (S, N)]
                if _are_apart(S) and _are_apart(N) and not np.allclose(axes[0], axes[0][0]):
                    for axis, pair in enumerate(zip(*axes, strict=True)):
                        curves[axes_name(name, [axis], alone=False)] = name, grid, None, *pair
                    if error is not None:
                        curves[name] = name, grid, error, None, None
                    continue
                rejection, noise = spectral_norms(S), spectral_norms(N)
        curves[name] = name, grid, error, rejection, noise
    return curves


def _are_apart(response: ComplexArray) -> bool:
    """Whether a response (f, n, n) is diagonal, but for rounding."""
    if response.shape[1] != response.shape[2]:
        return False
    others = np.abs(response[:, ~np.eye(response.shape[1], dtype=np.bool_)])
    return bool(np.max(others, initial=0.0) <= _APART * np.max(np.abs(response)))


def _vibration_frequencies(designs: Iterable[Design]) -> list[float]:
    frequencies_hz = {
        line.frequency_hz
        for design in designs
        if design.is_estimator and design.plant is not None
        for line in design.plant.vibrations
    }
    return sorted(frequencies_hz)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenLoop:
    """A broken loop of a design, as it is drawn."""

    design: str
    name: str  # in the legend: the design, and its axes where they differ
    look: int  # that of the design
    dash: int | None  # None for the first of its axes
    broken: BrokenLoop | None  # None where the loop is unstable

    @property
    def margins(self) -> str:
        """Phase and gain margins as text."""
        if self.broken is None:
            return "unstable"
        point = self.broken.phase_margin
        texts = [] if point is None else [f"{point.phase_deg:.1f}° at {point.frequency_hz:.3g} Hz"]
        gains = [f"{20 * np.log10(point.gain):+.1f}" for point in self.broken.gain_margins]
        return ", ".join(texts + ([f"{' / '.join(gains)} dB"] if gains else []))

    @property
    def points(self) -> tuple[FloatArray, FloatArray, FloatArray, ComplexArray]:
        """Frequency [Hz], gain [dB], phase [deg] and response where a curve is drawn, (f,) each."""
        loop = self.broken
        if loop is None:
            return np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.complex128)
        shown = loop.frequency_hz >= loop.frequency_hz[-1] / 10**_DECADES
        columns = loop.frequency_hz, loop.gain_db, loop.phase_deg
        f, gain, phase = (column[shown] for column in columns)
        return f, gain, phase, loop.response[shown]

    def draw(self, panel: Panel, x: ArrayLike, y: ArrayLike) -> None:
        """Draw a curve in the look of the loop, named with its margins."""
        name = f"{shorten(self.name, 24)}: {self.margins}"
        panel.curve(name, x, y, look=self.look, dash=self.dash)


def closed_loops(designs: Mapping[str, Design], sensor_gain: float) -> dict[str, ClosedLoop]:
    """Close the loop of each design; one without a loop is refused."""
    if not designs:
        raise ProblemError("a plot of loops needs at least one design; got none.")
    loops = {}
    for name, design in designs.items():
        if design.hardware is None:
            raise ProblemError(
                f"{name} is a filter of a bare estimation problem; expected a design for a loop."
            )
        loops[name] = close_loop(design.hardware, design.controller, sensor_gain=sensor_gain)
    return loops


def axes_name(design: str, measurements: Sequence[int], *, alone: bool) -> str:
    """Name the axes of a design; those of one that has only equal ones are the design."""
    if alone:
        return design
    numbers = " and ".join(str(index + 1) for index in measurements)
    return f"{design}, {'axis' if len(measurements) == 1 else 'axes'} {numbers}"


def open_loops(designs: Mapping[str, Design], *, sensor_gain: float = 1.0) -> list[OpenLoop]:
    """Break the loop of each design; equal axes are one."""
    return break_loops(closed_loops(designs, sensor_gain))


def break_loops(loops: Mapping[str, ClosedLoop]) -> list[OpenLoop]:
    """Break the loops of designs at each measurement, the others closed; equal axes are one."""
    opened = []
    for look, (design, loop) in enumerate(loops.items()):
        groups = broken_loops(loop) if loop.is_stable else (None,)
        for number, broken in enumerate(groups):
            measurements = () if broken is None else broken.measurements
            name = axes_name(design, measurements, alone=len(groups) == 1)
            dash = look + number if number else None
            opened.append(OpenLoop(design=design, name=name, look=look, dash=dash, broken=broken))
    return opened


def bode_figure(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, axes: OwnAxes = None
) -> Figure:
    """Gain and phase of loops over frequency, with their margins.

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
        Two panels. Each measurement is broken in turn, the others closed; axes that respond
        alike are one curve. Margins are marked and in the legend. The phase has no jumps and
        includes the delay.

    Raises
    ------
    ProblemError
        If there is no design, one has no loop, or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4)
    >>> len(lbt.report.figures.bode_figure({"slow": slow}).axes)
    2
    """
    return draw_bode(open_loops(designs, sensor_gain=sensor_gain), axes=axes)


def draw_bode(loops: Sequence[OpenLoop], *, axes: OwnAxes = None) -> Figure:
    """Draw gain and phase of broken loops, with their margins."""
    curves = [each.points for each in loops if each.broken is not None]
    gains = np.concatenate([np.zeros(1), *(gain for _, gain, *_ in curves)])
    phases = np.concatenate([[-180.0, -90.0], *(phase for _, _, phase, _ in curves)])
    y_axis = {
        "label": "loop gain",
        "unit": "dB",
        "low": _LOWEST_DB if np.min(gains) < _LOWEST_DB else None,
        "high": _HIGHEST_DB if np.max(gains) > _HIGHEST_DB else None,
    }
    with drawing([PANEL_IN, PANEL_IN], axes=axes) as (above, below):
        above.set_axes(FREQUENCY, y_axis)
        below.set_axes(FREQUENCY, {"label": "phase", "unit": "deg"})
        above.rule("", 0.0, "y", dash=1)
        for each in loops:
            f, gain, phase, _ = each.points
            each.draw(above, f, np.maximum(gain, 2 * _LOWEST_DB))  # a zero is far below
            if each.broken is not None:
                each.draw(below, f, phase)
        for at in _critical_phases(float(np.nanmin(phases)), float(np.nanmax(phases))):
            below.rule("", at, "y", dash=1)
        for broken in (each.broken for each in loops if each.broken is not None):
            for frequency_hz, ends in _gain_marks(broken):
                _mark(above, "gain margin", [frequency_hz] * 2, ends, "s")
            for frequency_hz, ends in _phase_marks(broken):
                _mark(below, "phase margin", [frequency_hz] * 2, ends, "o")
    return above.figure


def nyquist_figure(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, axes: OwnAxes = None
) -> Figure:
    """Broken loops in the complex plane, with the disks that they keep out of.

    Parameters
    ----------
    designs : mapping of str to Design
        Designs by the name in the title of their panel; each needs a loop.
    sensor_gain : float, optional
        Real sensor gain, relative to the one of each design.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One panel per design, as :func:`bode_figure` breaks its loop. Around -1 are the circles
        of the modulus margin and of the disk margin of all axes at once; no loop enters them.

    Raises
    ------
    ProblemError
        If there is no design, one has no loop, or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4)
    >>> len(lbt.report.figures.nyquist_figure({"slow": slow}).axes)
    1
    """
    loops = closed_loops(designs, sensor_gain)
    columns = min(2, len(loops))
    with drawing([square_in(columns)] * len(loops), columns=columns, axes=axes) as panels:
        for panel, (name, loop) in zip(panels, loops.items(), strict=True):
            _draw_nyquist(panel, name, loop)
    return panels[0].figure


def _draw_nyquist(panel: Panel, name: str, loop: ClosedLoop) -> None:
    """Draw the broken loops of a design in the complex plane."""
    x, y = (
        {"label": f"{part} part", "unit": "-", "low": low, "high": low + 2 * _REACH}
        for part, low in (("real", -0.7 * 2 * _REACH), ("imaginary", -_REACH))
    )
    margins, title = None, f"{name}: unstable"
    if loop.is_stable:
        margins = loop_margins(loop)
        title = f"{name}: disk {margins.disk:.2f}, modulus {margins.modulus:.2f}"
    panel.set_axes(x, y, title=title, equal=True)
    panel.curve("unit circle", np.cos(_TURN), np.sin(_TURN), dash=3, **_THIN)
    _mark(panel, "critical point", [-1.0], [0.0], "x")
    if margins is None:
        return
    opened = break_loops({name: loop})
    for number, each in enumerate(opened):
        assert each.broken is not None  # that of a stable loop
        shown = np.where(np.abs(each.broken.response) < _FAR, each.broken.response, np.nan)
        label = axes_name("loop", each.broken.measurements, alone=len(opened) == 1)
        panel.curve(label, shown.real, shown.imag, dash=number)
        pale: dict[str, Any] = {"dash": number, "opacity": 0.35, "numbers": False}
        panel.curve("negative frequencies", shown.real, -shown.imag, **pale)
        if (point := each.broken.phase_margin) is not None:
            ends = [0.0, point.response.real], [0.0, point.response.imag]
            _mark(panel, "phase margin", *ends, "o")
        for point in each.broken.gain_margins:
            _mark(panel, "gain margin", [point.response.real], [0.0], "s")
    low, high = margins.disk_gain_low, min(margins.disk_gain_high, 1e3)
    for label, centre, radius, look in (
        ("modulus margin", -1.0, margins.modulus, 2),
        ("disk margin", -(low + high) / 2, (high - low) / 2, 1),
    ):
        places = centre + radius * np.cos(_TURN), radius * np.sin(_TURN)
        panel.curve(label, *places, look=look, width=1.2, numbers=False)


def nichols_figure(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, axes: OwnAxes = None
) -> Figure:
    """Gain over phase of loops, with their margins and contours of the modulus margin.

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
        One panel, of the loops of :func:`bode_figure`. A loop that stays outside a contour has
        its modulus margin.

    Raises
    ------
    ProblemError
        If there is no design, one has no loop, or ``axes`` are not one per panel.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4)
    >>> len(lbt.report.figures.nichols_figure({"slow": slow}).axes)
    1
    """
    opened = open_loops(designs, sensor_gain=sensor_gain)
    loops = [each.broken for each in opened if each.broken is not None]
    phases = [_within(phase, gain) for _, gain, phase, _ in (each.points for each in opened)]
    reach = np.concatenate([[-360.0, 0.0], *phases])
    lowest, highest = float(np.nanmin(reach)), float(np.nanmax(reach))
    x_axis = {"label": "phase", "unit": "deg", "low": lowest, "high": highest}
    with drawing([2 * PANEL_IN], axes=axes) as (panel,):
        panel.set_axes(x_axis, {"label": "loop gain", "unit": "dB", "high": 40.0})
        for each in opened:
            _, gain, phase, _ = each.points
            gain, phase = _within(gain, gain), _within(phase, gain)
            each.draw(panel, phase, gain)
        for broken in loops:
            for _, ends in _phase_marks(broken):
                _mark(panel, "phase margin", ends, [0.0, 0.0], "o")
            for frequency_hz, ends in _gain_marks(broken):
                phase_deg = float(np.interp(frequency_hz, broken.frequency_hz, broken.phase_deg))
                _mark(panel, "gain margin", [phase_deg] * 2, ends, "s")
        for at in _critical_phases(lowest, highest):
            for dash, modulus in enumerate(_MODULI, start=1):
                point = 1 - modulus * np.exp(1j * _TURN)
                degrees, decibels = at + np.degrees(np.angle(point)), 20 * np.log10(np.abs(point))
                panel.curve(f"modulus {modulus:g}", degrees, decibels, dash=dash, **_THIN)
            _mark(panel, "critical point", [at], [0.0], "x")
    return panel.figure


def _within(values: FloatArray, gain_db: FloatArray) -> FloatArray:
    """Return values where the gain is one that is drawn, nan elsewhere."""
    return np.where((gain_db > _LOWEST_DB) & (gain_db < _HIGHEST_DB), values, np.nan)


def _mark(panel: Panel, name: str, x: Sequence[float], y: Sequence[float], marker: str) -> None:
    """Draw what marks a margin: its point, the last one, and a line to it."""
    panel.curve("", x, y, dash=0, **_THIN)
    panel.curve(name, x[-1:], y[-1:], line=False, marker=marker, look=None, size=4.5)


def _phase_marks(broken: BrokenLoop) -> list[tuple[float, list[float]]]:
    """Return frequency [Hz] of the phase margin, and the phases [deg] that it lies between."""
    point = broken.phase_margin
    if point is None:
        return []
    phase = float(np.interp(point.frequency_hz, broken.frequency_hz, broken.phase_deg))
    return [(point.frequency_hz, [phase - point.phase_deg, phase])]


def _gain_marks(broken: BrokenLoop) -> list[tuple[float, list[float]]]:
    """Return frequencies [Hz] of gain margins, and the gains [dB] that each lies between."""
    least = broken.frequency_hz[-1] / 10**_DECADES
    return [
        (max(point.frequency_hz, least), [0.0, -20 * float(np.log10(point.gain))])
        for point in broken.gain_margins
    ]


def _critical_phases(lowest: float, highest: float) -> list[float]:
    """Return the phases [deg] within a range at which a gain of one is -1."""
    first, last = np.ceil((lowest + 180) / 360), np.floor((highest + 180) / 360)
    return [float(360 * k - 180) for k in np.arange(first, last + 1)]


def design_steps(
    designs: Mapping[str, Design], *, sensor_gain: float = 1.0, frames: int = SHOWN_FRAMES
) -> Steps:
    """Return the step responses of designs; axes that respond alike are one."""
    steps: dict[str, list[LoopStep]] = {}
    for name, loop in closed_loops(designs, sensor_gain).items():
        unlike: list[LoopStep] = []
        for axis in range(loop.hardware.modes if loop.is_stable else 0):
            step = step_response(loop, axis=axis, frames=frames)
            if not any(np.allclose(step.residual, each.residual) for each in unlike):
                unlike.append(step)
        steps[name] = unlike
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
    return draw_steps(design_steps(designs, sensor_gain=sensor_gain), axes=axes)


def draw_steps(steps: Steps, *, height_nm: float | None = None, axes: OwnAxes = None) -> Figure:
    """Draw residual and command after a step; without its height as parts of it."""
    names, unit = list(steps), "-" if height_nm is None else "nm"
    with drawing([PANEL_IN, PANEL_IN], axes=axes) as panels:
        for panel, label in zip(panels, ("residual", "command"), strict=True):
            text = f"{label}, part of the step" if height_nm is None else label
            panel.set_axes(
                {"label": "time after the step", "unit": "ms"}, {"label": text, "unit": unit}
            )
            for look, (design, responses) in enumerate(steps.items()):
                if not responses:
                    draw_design(panel, names, design, [], None)
                for number, step in enumerate(responses):
                    panel.curve(
                        axes_name(design, [step.axis], alone=len(responses) == 1),
                        1e3 * step.time_s,
                        (height_nm or 1.0) * getattr(step, label),
                        look=look,
                        dash=look + number if number else None,
                        step="steps-post",
                    )
    return panels[0].figure
