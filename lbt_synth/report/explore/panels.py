"""The figures of the page of sliders; their scales move in steps, so that curves move in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from bokeh.models import ColumnDataSource, GridBox, HoverTool, PlainText, Range1d
from bokeh.plotting import figure as new_figure

from lbt_synth.report.draw import colour, dashes
from lbt_synth.report.explore.exploration import Shown
from lbt_synth.report.figures.studies import strehl_axis
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.validation import FloatArray

Ends: TypeAlias = tuple[tuple[float, float], tuple[float, float]]  # of the scales of x and y
# curves by the names of designs, abscissae of rules, and the scales
Numbers: TypeAlias = tuple[dict[str, tuple[FloatArray, FloatArray]], Sequence[float], Ends]
_REACH = 3.0  # of the plane of a loop gain, to each side of -1
_FAR = 9.0  # outside that plane; a canvas takes no larger numbers
_ROOM = 0.05  # decades above the highest curve
_GREY = "#404040"
# of each figure: what is on its axes, and which of them are logarithmic
_AXES = {
    "explore-rejection": ("frequency [Hz]", "\u03c3\u0304, phase to residual [-]", "xy"),
    "explore-noise": ("frequency [Hz]", "\u03c3\u0304, noise to residual [-]", "xy"),
    "explore-nyquist": ("real part [-]", "imaginary part [-]", ""),
    "explore-spectrum": ("frequency [Hz]", "power spectrum [{nm²/Hz}]", "xy"),
    "explore-strehl": ("frequency error [Hz]", "Strehl ratio [%]", ""),
    "explore-poles": ("real part [-]", "imaginary part [-]", ""),
    "explore-sigma": ("frequency [Hz]", "\u03c3\u0304, disturbances to error [{nm}]", "xy"),
}
_STYLE = {
    "axis_label_text_font_size": "13px",
    "axis_label_text_font_style": "normal",
    "major_label_text_font_size": "12px",
    "axis_line_color": "#808080",
    "minor_tick_line_color": None,
}


def explore_numbers(
    shown: Mapping[str, Shown], lines_hz: Sequence[float], shift_hz: float
) -> dict[str, Numbers]:
    """Return what each figure shows of designs, with true lines and where the slider stands."""
    density, error = shown_unit("nm²/Hz")[1], shown_unit("nm")[1]
    numbers: dict[str, Numbers] = {}
    for key, field, factor, decades in (
        ("explore-rejection", "rejection", 1.0, 4),
        ("explore-noise", "noise_transfer", 1.0, 2),
        ("explore-spectrum", "spectrum_nm2_hz", density, 4),
        ("explore-sigma", "error_nm", error, 2),
    ):
        curves = {
            name: (one.frequency_hz, factor * getattr(one, field))
            for name, one in shown.items()
            if getattr(one, field) is not None
        }
        values = np.concatenate([np.ones(1), *(y for _, y in curves.values())])
        high = float(10.0 ** np.ceil(np.log10(np.nanmax(values)) + _ROOM))
        grid = next(iter(shown.values())).frequency_hz
        ends = (float(grid[0]), float(grid[-1])), (high / 10**decades, high)
        numbers[key] = curves, lines_hz, ends
    numbers["explore-nyquist"] = (
        {name: _loop_gains(one) for name, one in shown.items()},
        (),
        ((-1.0 - _REACH, -1.0 + _REACH), (-_REACH, _REACH)),
    )
    poles = {name: (one.poles.real, one.poles.imag) for name, one in shown.items()}
    numbers["explore-poles"] = poles, (), ((-1.2, 1.2), (-1.2, 1.2))
    strehls = {
        name: (one.shift_hz, 100 * one.strehls)
        for name, one in shown.items()
        if one.shift_hz is not None and one.strehls is not None
    }
    percents = np.concatenate([np.zeros(0), *(y for _, y in strehls.values())])
    low = strehl_axis(percents)["low"]
    high = np.nanmax(percents) if np.isfinite(percents).any() else 100.0
    shifts = np.concatenate([np.array([shift_hz]), *(x for x, _ in strehls.values())])
    across = float(np.min(shifts)) - 1e-9, float(np.max(shifts)) + 1e-9
    numbers["explore-strehl"] = strehls, [shift_hz], (across, (low, high + 0.04 * (high - low)))
    return {key: numbers[key] for key in _AXES}


def _loop_gains(one: Shown) -> tuple[FloatArray, FloatArray]:
    """Return the loop gains of all measurements, each broken in turn, with gaps between them."""
    near = np.clip(one.broken.real, -_FAR, _FAR) + 1j * np.clip(one.broken.imag, -_FAR, _FAR)
    line = np.pad(near, ((0, 0), (0, 1)), constant_values=np.nan).ravel()
    return line.real, line.imag


class LivePanel:
    """A place for a figure, which is made again only where its designs are others."""

    def __init__(self, key: str) -> None:
        self.root = GridBox(name=key, sizing_mode="stretch_width")
        self._key = key
        self._texts = [
            text.format_map({unit: shown_unit(unit)[0] for unit in ("nm", "nm²/Hz")})
            for text in _AXES[key][:2]
        ]
        self._log = _AXES[key][2]
        self._designs: object = None
        self._ends: Ends | None = None
        self._sources: list[ColumnDataSource] = []

    def show(self, numbers: Numbers, looks: Mapping[str, int]) -> None:
        """Show curves in the looks of their designs."""
        curves, rules, ends = numbers
        groups: dict[bytes, list[str]] = {}  # curves of the same abscissae are sent together
        for name, (x, _) in curves.items():
            groups.setdefault(x.tobytes(), []).append(name)
        columns = [{"at": np.array(rules)}] if len(rules) else []
        for names in groups.values():
            ordinates = {f"y{i}": self._drawn(curves[name][1]) for i, name in enumerate(names)}
            columns.append({"x": curves[names[0]][0], **ordinates})
        designs = [[(name, looks[name]) for name in names] for names in groups.values()]
        if [bool(rules), *designs] != self._designs:
            self._designs, self._ends = [bool(rules), *designs], None
            self._sources = [ColumnDataSource(one) for one in columns]
            self.root.children = [(self._new_figure(designs, bool(rules)), 0, 0)]
        else:
            for source, new in zip(self._sources, columns, strict=True):
                old = source.data
                if not all(np.array_equal(old[n], new[n], equal_nan=True) for n in new):
                    source.data = new
        if ends != self._ends:
            self._ends, figure = ends, self.root.children[0][0]
            for scale, (start, end) in zip((figure.x_range, figure.y_range), ends, strict=True):
                scale.update(start=start, end=end)

    def _drawn(self, y: FloatArray) -> FloatArray:
        return np.where(y > 0, y, np.nan) if "y" in self._log else y

    def _new_figure(self, designs: Sequence[Sequence[tuple[str, int]]], ruled: bool) -> Any:
        square = self._key in ("explore-nyquist", "explore-poles")
        size = {"aspect_ratio": 1.0, "max_width": 460} if square else {"height": 300}
        figure = new_figure(
            **{f"{n}_axis_type": "log" if n in self._log else "linear" for n in "xy"},
            x_range=Range1d(),
            y_range=Range1d(),
            sizing_mode="stretch_width",
            tools="box_zoom,pan,wheel_zoom,reset",
            toolbar_location="above",
            min_border_left=64,  # figures above each other are in line
            min_border_right=12,
            **size,
        )
        # a finger scrolls the page
        figure.toolbar.update(logo=None, active_drag=None, active_scroll=None)
        figure.grid.grid_line_color = "#e0e0e0"
        figure.outline_line_color = None
        for axis, text in zip((figure.xaxis[0], figure.yaxis[0]), self._texts, strict=True):
            axis.update(axis_label=PlainText(text=text), **_STYLE)
        remaining = iter(self._sources)
        if ruled:
            dash = "6 3" if self._key == "explore-strehl" else "4 5"
            style = {"line_color": _GREY, "line_width": 1.2, "line_dash": dash}
            figure.vspan(x="at", source=next(remaining), **style)
        curves = []
        for group, source in zip(designs, remaining, strict=True):
            for i, (name, look) in enumerate(group):
                curves.append(self._new_curve(figure, source, f"y{i}", look))
                curves[-1].name = f"design {name}"
        self._draw_guides(figure)
        tips = [("", "$name")]
        tips += [(t, f"$snap_{n}{{%.4g}}") for t, n in zip(self._texts, "xy", strict=True)]
        formats = {f"$snap_{n}": "printf" for n in "xy"}
        figure.add_tools(HoverTool(renderers=curves, tooltips=tips, formatters=formats))
        return figure

    def _new_curve(self, figure: Any, source: ColumnDataSource, y: str, look: int) -> Any:
        shade, place = colour(look), {"x": "x", "y": y, "source": source}
        if self._key == "explore-poles":
            markers = ("circle", "square", "triangle", "diamond", "cross", "x")
            style = {"size": 8, "line_width": 1.5, "fill_color": None, "line_color": shade}
            return figure.scatter(**place, marker=markers[look % len(markers)], **style)
        strokes = [max(1, round(2.4 * stroke)) for stroke in dashes(look)]
        return figure.line(**place, line_color=shade, line_width=2, line_dash=strokes)

    def _draw_guides(self, figure: Any) -> None:
        """Draw what the curves are compared with."""
        thin = {"line_color": _GREY, "line_width": 1.2}
        if self._key == "explore-rejection":
            figure.hspan(y=[1.0], **thin)
        elif self._key == "explore-nyquist":
            figure.scatter([-1.0], [0.0], marker="cross", size=13, line_color=_GREY)
        elif self._key == "explore-poles":
            turn = np.linspace(0, 2 * np.pi, 181)
            figure.line(np.cos(turn), np.sin(turn), **thin)
