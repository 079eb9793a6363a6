"""The charts of the page of sliders; their scales move in steps, so that curves move in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.report.charts.description import Axis, Chart, Curve, Mark, Panel, Rule
from lbt_synth.report.explore.evaluation import LoopCurves, Performance
from lbt_synth.report.figures.loop import frequency_panel, vibration_rules
from lbt_synth.report.figures.robustness import SHORT_FREQUENCY_ERROR, strehl_axis
from lbt_synth.report.figures.simulation import spectra_panel
from lbt_synth.report.page.words import chart

_REACH = 3.0  # of the plane of a loop gain, to each side of -1
_ROOM = 0.05  # decades above the highest curve


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """A design on the page: its curves, and what it leaves once that is known."""

    curves: LoopCurves
    performance: Performance | None


def explore_charts(
    shown: Mapping[str, Shown], lines_hz: Sequence[float], shift_hz: float
) -> tuple[Chart, ...]:
    """Return the charts of designs by name, the lines of the truth and their shift marked."""
    rules = vibration_rules(lines_hz, "true line")
    found = {name: one.curves for name, one in shown.items()}
    left = {name: one.performance for name, one in shown.items() if one.performance is not None}
    looks = {name: look for look, name in enumerate(shown)}

    def curves(field: str) -> list[Mark]:
        return [
            Curve(name=name, x=one.frequency_hz, y=getattr(one, field), look=looks[name])
            for name, one in found.items()
            if getattr(one, field) is not None
        ]

    unity = Rule(name="", at=1.0, axis="y")
    panels = {
        "explore-rejection": _in_decades(
            frequency_panel("phase to residual", "-", [*curves("rejection"), unity], rules), 4
        ),
        "explore-noise": _in_decades(
            frequency_panel("noise to residual", "-", curves("noise_transfer"), rules), 2
        ),
        "explore-nyquist": _nyquist_panel(found, looks),
        "explore-spectrum": _in_decades(spectra_panel([*curves("spectrum_nm2_hz"), *rules]), 4),
        "explore-strehl": _strehl_panel(left, looks, shift_hz),
        "explore-poles": _pole_panel(found, looks),
        "explore-sigma": _in_decades(
            frequency_panel("disturbances to error", "nm", curves("error_nm"), rules), 2
        ),
    }
    return tuple(chart(key, [panel]) for key, panel in panels.items())


def _in_decades(panel: Panel, decades: int) -> Panel:
    """Return a panel whose scale of y ends at the decade above its curves, and so far below."""
    values = np.concatenate([np.ones(1), *(curve.y for curve in panel.select(Curve))])
    high = 10.0 ** np.ceil(np.log10(np.nanmax(values)) + _ROOM)
    return replace(panel, y=replace(panel.y, low=high / 10**decades, high=high), height_in=2.1)


def _strehl_panel(left: Mapping[str, Performance], looks: Mapping[str, int], now: float) -> Panel:
    marks = [
        Curve(name=name, x=one.shift_hz, y=100 * one.strehls, look=looks[name])
        for name, one in left.items()
    ]
    return Panel(
        x=SHORT_FREQUENCY_ERROR,
        y=strehl_axis(marks),
        marks=(*marks, Rule(name="now", at=now, dash=1)),
        height_in=2.1,
    )


def _nyquist_panel(found: Mapping[str, LoopCurves], looks: Mapping[str, int]) -> Panel:
    """Return the loop gains of all measurements, each broken in turn, around the point -1."""
    marks = []
    for name, one in found.items():
        # far outside the panel a canvas takes no more numbers; a gap parts the measurements
        near = np.clip(one.broken.real, -9.0, 9.0) + 1j * np.clip(one.broken.imag, -9.0, 9.0)
        line = np.pad(near, ((0, 0), (0, 1)), constant_values=np.nan).ravel()
        marks.append(Curve(name=name, x=line.real, y=line.imag, look=looks[name], hover=False))
    critical = Curve(
        name="-1",
        x=np.full(1, -1.0),
        y=np.zeros(1),
        line=False,
        marker="plus",
        look=None,
        hover=False,
        size=8.0,
    )
    across, up = (
        Axis(label=f"{part} part", unit="-", low=middle - _REACH, high=middle + _REACH)
        for part, middle in (("real", -1.0), ("imaginary", 0.0))
    )
    return Panel(x=across, y=up, marks=(*marks, critical), equal=True)


def _pole_panel(found: Mapping[str, LoopCurves], looks: Mapping[str, int]) -> Panel:
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 181))
    circle = Curve(name="", x=turn.real, y=turn.imag, look=None, width=1.0, hover=False)
    poles = [
        Curve(
            name=name,
            x=one.poles.real,
            y=one.poles.imag,
            look=looks[name],
            line=False,
            marker="own",
            filled=False,
        )
        for name, one in found.items()
    ]
    x, y = (
        Axis(label=f"{part} part", unit="-", low=-1.2, high=1.2) for part in ("real", "imaginary")
    )
    return Panel(x=x, y=y, marks=(circle, *poles), equal=True)
