"""Classical views of loops broken at each measurement: Bode, Nyquist and Nichols."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.loop import ClosedLoop, broken_loops, close_loop, loop_margins
from lbt_synth.loop.broken_loops import BrokenLoop
from lbt_synth.report.charts.description import Axis, Curve, Mark, Panel, Rule
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.charts.scales import shorten
from lbt_synth.report.figures.loop import DECADES, FREQUENCY
from lbt_synth.validation import ComplexArray, FloatArray

_LOWEST_DB, _HIGHEST_DB = -40.0, 60.0
_REACH = 2.5  # of a Nyquist plot from its centre
_FAR = 8.0  # loop gain beyond which a Nyquist plot draws nothing
_MODULI = (0.3, 0.5, 0.7)  # modulus margins whose contours a Nichols plot has
_TURN = np.linspace(0, 2 * np.pi, 241)
_POINT: dict[str, Any] = {"look": None, "width": 1.0, "dash": 0, "size": 4.5, "hover": False}


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
        found = self.broken
        if found is None:
            return np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.complex128)
        shown = found.frequency_hz >= found.frequency_hz[-1] / 10**DECADES
        columns = found.frequency_hz, found.gain_db, found.phase_deg
        f, gain, phase = (column[shown] for column in columns)
        return f, gain, phase, found.response[shown]

    def curve(self, x: FloatArray, y: FloatArray, **more: Any) -> Curve:
        """Return a curve in the look of the loop, named with its margins."""
        name = f"{shorten(self.name, 24)}: {self.margins}"
        return Curve(name=name, x=x, y=y, look=self.look, dash=self.dash, **more)


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
    loops = closed_loops(designs, sensor_gain)
    return [
        each
        for look, (design, loop) in enumerate(loops.items())
        for each in break_loop(design, loop, look)
    ]


def break_loop(design: str, loop: ClosedLoop, look: int) -> list[OpenLoop]:
    """Break the loop of one design; equal axes are one."""
    groups = broken_loops(loop) if loop.is_stable else (None,)
    return [
        OpenLoop(
            design=design,
            name=axes_name(
                design, () if broken is None else broken.measurements, alone=len(groups) == 1
            ),
            look=look,
            dash=look + number if number else None,
            broken=broken,
        )
        for number, broken in enumerate(groups)
    ]


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
    return draw_figure(bode_panels(open_loops(designs, sensor_gain=sensor_gain)), axes=axes)


def bode_panels(loops: Sequence[OpenLoop]) -> tuple[Panel, Panel]:
    """Return the panels of gain and phase of broken loops, with their margins."""
    gains: list[Mark] = [Rule(name="", at=0.0, axis="y", dash=1)]
    phases: list[Mark] = []
    gain_marks: list[Mark] = []
    phase_marks: list[Mark] = []
    lowest, highest = -180.0, -90.0
    low, high = np.inf, -np.inf
    for each in loops:
        found = each.broken
        if found is None:
            gains.append(each.curve(np.zeros(0), np.zeros(0)))
            continue
        f, gain, phase, _ = each.points
        low, high = min(low, float(np.min(gain))), max(high, float(np.max(gain)))
        gains.append(each.curve(f, np.maximum(gain, 2 * _LOWEST_DB)))  # a zero is far below
        phases.append(each.curve(f, phase))
        lowest = min(lowest, float(np.nanmin(phase)))
        highest = max(highest, float(np.nanmax(phase)))
        for frequency_hz, ends in _gain_marks(found):
            gain_marks += _mark("gain margin", [frequency_hz] * 2, ends, "square")
        for frequency_hz, ends in _phase_marks(found):
            phase_marks += _mark("phase margin", [frequency_hz] * 2, ends, "circle")
    phases += [Rule(name="", at=at, axis="y", dash=1) for at in _critical_phases(lowest, highest)]
    y = Axis(
        label="loop gain",
        unit="dB",
        low=_LOWEST_DB if low < _LOWEST_DB else None,
        high=_HIGHEST_DB if high > _HIGHEST_DB else None,
    )
    below = Axis(label="phase", unit="deg")
    return (
        Panel(x=FREQUENCY, y=y, marks=(*gains, *gain_marks)),
        Panel(x=FREQUENCY, y=below, marks=(*phases, *phase_marks)),
    )


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
    loops, panels = closed_loops(designs, sensor_gain), []
    x, y = (
        Axis(label=f"{part} part", unit="-", low=low, high=low + 2 * _REACH)
        for part, low in (("real", -0.7 * 2 * _REACH), ("imaginary", -_REACH))
    )
    unit = Curve(name="unit circle", x=np.cos(_TURN), y=np.sin(_TURN), **_POINT | {"dash": 3})
    minus = _mark("critical point", [-1.0], [0.0], "cross")
    for name, loop in loops.items():
        marks, title = [unit, *minus], f"{name}: unstable"
        if loop.is_stable:
            found = break_loop(name, loop, look=0)
            for number, each in enumerate(found):
                marks += _nyquist_marks(each, number=number, alone=len(found) == 1)
            margins = loop_margins(loop)
            low, high = margins.disk_gain_low, min(margins.disk_gain_high, 1e3)
            for label, centre, radius, look in (
                ("modulus margin", -1.0, margins.modulus, 2),
                ("disk margin", -(low + high) / 2, (high - low) / 2, 1),
            ):
                places = centre + radius * np.cos(_TURN), radius * np.sin(_TURN)
                marks.append(
                    Curve(name=label, x=places[0], y=places[1], look=look, width=1.2, hover=False)
                )
            title = f"{name}: disk {margins.disk:.2f}, modulus {margins.modulus:.2f}"
        panels.append(Panel(x=x, y=y, marks=tuple(marks), title=title, equal=True))
    return draw_figure(panels, columns=min(2, len(panels)), axes=axes)


def _nyquist_marks(each: OpenLoop, *, number: int, alone: bool) -> list[Curve]:
    """Return the curve of a broken loop in the complex plane, and its margins."""
    assert each.broken is not None  # that of a stable loop
    response = np.where(np.abs(each.broken.response) < _FAR, each.broken.response, np.nan)
    name = axes_name("loop", each.broken.measurements, alone=alone)
    style: dict[str, Any] = {"look": 0, "dash": number}
    marks = [
        Curve(name=name, x=response.real, y=response.imag, **style),
        Curve(name="", x=response.real, y=-response.imag, opacity=0.35, hover=False, **style),
    ]
    if (point := each.broken.phase_margin) is not None:
        ends = [0.0, point.response.real], [0.0, point.response.imag]
        marks += _mark("phase margin", *ends, "circle")
    for point in each.broken.gain_margins:
        marks += _mark("gain margin", [point.response.real], [0.0], "square")
    return marks


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
    curves: list[Mark] = []
    marks: list[Mark] = []
    lowest, highest = -360.0, 0.0
    for each in open_loops(designs, sensor_gain=sensor_gain):
        found = each.broken
        if found is None:
            curves.append(each.curve(np.zeros(0), np.zeros(0)))
            continue
        phase = _within(found.phase_deg, found.gain_db)
        lowest = min(lowest, float(np.nanmin(phase)))
        highest = max(highest, float(np.nanmax(phase)))
        curves.append(each.curve(phase, _within(found.gain_db, found.gain_db)))
        for _, ends in _phase_marks(found):
            marks += _mark("phase margin", ends, [0.0, 0.0], "circle")
        for frequency_hz, ends in _gain_marks(found):
            phase_deg = float(np.interp(frequency_hz, found.frequency_hz, found.phase_deg))
            marks += _mark("gain margin", [phase_deg] * 2, ends, "square")
    for at in _critical_phases(lowest, highest):
        for dash, modulus in enumerate(_MODULI, start=1):
            point = 1 - modulus * np.exp(1j * _TURN)
            degrees, decibels = at + np.degrees(np.angle(point)), 20 * np.log10(np.abs(point))
            style = _POINT | {"dash": dash}
            marks.append(Curve(name=f"modulus {modulus:g}", x=degrees, y=decibels, **style))
        marks += _mark("critical point", [at], [0.0], "cross")
    x = Axis(label="phase", unit="deg", low=lowest, high=highest)
    y = Axis(label="loop gain", unit="dB", high=40.0)
    return draw_figure([Panel(x=x, y=y, marks=(*curves, *marks), height_in=4.2)], axes=axes)


def _within(values: FloatArray, gain_db: FloatArray) -> FloatArray:
    """Return values where the gain is one that is drawn, nan elsewhere."""
    return np.where((gain_db > _LOWEST_DB) & (gain_db < _HIGHEST_DB), values, np.nan)


def _mark(name: str, x: Sequence[float], y: Sequence[float], marker: str) -> list[Curve]:
    """Return what marks a margin: its point, the last one, and a line to it."""
    along, up = np.array(x), np.array(y)
    point = Curve(name=name, x=along[-1:], y=up[-1:], line=False, marker=marker, **_POINT)
    return [Curve(name="", x=along, y=up, **_POINT), point]


def _phase_marks(found: BrokenLoop) -> list[tuple[float, list[float]]]:
    """Return frequency [Hz] of the phase margin, and the phases [deg] that it lies between."""
    point = found.phase_margin
    if point is None:
        return []
    phase = float(np.interp(point.frequency_hz, found.frequency_hz, found.phase_deg))
    return [(point.frequency_hz, [phase - point.phase_deg, phase])]


def _gain_marks(found: BrokenLoop) -> list[tuple[float, list[float]]]:
    """Return frequencies [Hz] of gain margins, and the gains [dB] that each lies between."""
    least = found.frequency_hz[-1] / 10**DECADES
    return [
        (max(point.frequency_hz, least), [0.0, -20 * float(np.log10(point.gain))])
        for point in found.gain_margins
    ]


def _critical_phases(lowest: float, highest: float) -> list[float]:
    """Return the phases [deg] within a range at which a gain of one is -1."""
    first, last = np.ceil((lowest + 180) / 360), np.floor((highest + 180) / 360)
    return [float(360 * k - 180) for k in np.arange(first, last + 1)]
