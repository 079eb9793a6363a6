"""How every figure is drawn: panels with the marks of the house, on new axes or the user's own.

A figure is a block of :func:`drawing`. It yields a :class:`Panel` for each pair of axes, on which
curves, areas, rules, bars and maps are drawn; at its end the scales, the legend and the colour bar
are set. Numbers in nm are drawn in the unit that is shown.
"""

from __future__ import annotations

import io
import os
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.storage.atomic_files import require_ending, write_atomically
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.warning_filters import ignore_warnings
from lbt_synth.validation import FloatArray

if TYPE_CHECKING:
    import matplotlib.figure
    from matplotlib.axes import Axes

Figure: TypeAlias = "matplotlib.figure.Figure"
OwnAxes: TypeAlias = "Axes | Sequence[Axes] | None"  # of the user, to draw on
FIGURE_ENDINGS = (".png", ".pdf", ".svg")

# Okabe and Ito's palette, in an order that also darkens and lightens in grey
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY = "#404040"
# Lengths of strokes and gaps, in widths of the line
_DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (4, 2),
    (6, 2, 1, 2),
    (1.2, 1.6),
    (6, 1.5, 1, 1.5, 1, 1.5),
    (2.5, 1.5),
)
_MARKERS = ("o", "s", "^", "D", "+", "x")
_SHADE = 0.2  # opacity of shaded areas
_BLANK: dict[str, Any] = {
    "facecolor": "#d9d9d9",
    "edgecolor": "0.55",
    "hatch": "////",
    "linewidth": 0,
}
_BAR_IN = 0.24  # height of a bar
_HIGHEST_IN = 7.5  # of a panel that fits a sheet of paper
PANEL_IN = 2.1  # height of a panel, unless it says another
_WIDTH_IN = 7.0  # of a figure
_LETTER_IN = 0.068  # width of a letter at 8 points, generously
_AROUND_IN = 0.55  # below and above the axes of a panel
_FLAG_IN = 0.15  # width of an upright text
_LONGEST = {"name": 60, "category": 36}  # letters in a legend, and beside bars
_ROOM = 0.04  # around what is drawn, as a part of its extent
_FEW_DECADES = 150  # ratio of the ends below which a logarithmic scale has ticks at 2 and 5, too
_MOST_RATIO = 1e8  # of the ends of a logarithmic scale: a zero must not stretch it
_CONTOURS = 6  # of a map, about, at round values


def colour(look: int | None) -> str:
    """Colour of a look, as #rrggbb; None is grey."""
    return GREY if look is None else _COLOURS[look % len(_COLOURS)]


def dashes(look: int | None) -> tuple[float, ...]:
    """Strokes and gaps of a look [widths of the line]; () is solid."""
    # where the colours repeat, dashes and markers are others
    return () if look is None else _DASHES[(look + look // len(_COLOURS)) % len(_DASHES)]


def marker_of(look: int | None) -> str:
    """Matplotlib's name of the marker of a look."""
    number = 0 if look is None else look
    return _MARKERS[(number + number // len(_COLOURS)) % len(_MARKERS)]


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib settings of this package, for the time of the block."""
    import matplotlib as mpl

    style = files("lbt_synth.report") / "house.mplstyle"
    # a name in a script that the font does not have stays a name
    with mpl.rc_context(fname=str(style)), ignore_warnings(message=r"Glyph .* missing"):
        yield


def require_figure_name(path: str | os.PathLike[str]) -> Path:
    """Refuse a file name that is not that of a figure."""
    return require_ending(path, "a figure", FIGURE_ENDINGS)


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure, whole or not at all."""
    target = require_figure_name(path)
    ending = target.suffix.lower()
    buffer = io.BytesIO()
    # without a date, the same figure is the same file
    undated: dict[str, dict[str, Any]] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
    with house_style():
        figure.savefig(buffer, format=ending[1:], metadata=undated.get(ending))
    return write_atomically(target, buffer.getvalue())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """Numbers that a figure draws, in the units that are shown: a curve, a row of a map, bars."""

    panel: str  # title of its panel, and what is up its y axis
    heading: str  # what x is, with its unit
    name: str  # what y is
    x: FloatArray | tuple[str, ...]  # (n,)
    y: FloatArray  # (n,)


_SERIES: WeakKeyDictionary[Figure, tuple[Series, ...]] = WeakKeyDictionary()


def figure_series(figure: Figure) -> tuple[Series, ...]:
    """Return the numbers of a figure that this package drew."""
    return _SERIES.get(figure, ())


@contextmanager
def drawing(
    heights_in: Sequence[float], *, columns: int = 1, axes: OwnAxes = None
) -> Iterator[list[Panel]]:
    """Yield a panel for each height [inch], row by row; set scales and legends at the end.

    The panels are those of a new figure, or stand on the user's own axes.
    """
    with house_style():
        panels = [Panel(place) for place in _places(heights_in, columns, axes)]
        yield panels
        for panel in panels:
            panel.finish()
        figure = panels[0].figure
        bar = _draw_colour_bar(panels, below=axes is None)
        if axes is None:
            rows = [heights_in[i : i + columns] for i in range(0, len(panels), columns)]
            lines = [panel.title_lines for panel in panels]
            height = sum(max(row) + _AROUND_IN for row in rows) + 0.6 * bar
            height += 0.17 * sum(max(lines[i : i + columns]) for i in range(0, len(lines), columns))
            _draw_legend(figure, panels, height)
            if any(panel.is_equal for panel in panels):
                # a layout that knew of equal scales would write labels over each other
                figure.draw_without_rendering()
                figure.set_layout_engine("none")
        else:
            for panel in panels:
                marks, names = _legend_entries([panel])
                if names:
                    panel.axes.legend(marks, names, handlelength=3.2)
        for panel in panels:
            if panel.is_equal:
                panel.axes.set_aspect("equal")
        _SERIES[figure] = tuple(one for panel in panels for one in panel.series)


def _places(heights_in: Sequence[float], columns: int, axes: OwnAxes) -> list[Axes]:
    """Return the axes of a new figure, row by row, or the user's own, one per panel."""
    from matplotlib.axes import Axes as Place
    from matplotlib.figure import Figure

    if axes is not None:
        own = list(np.ravel(np.asarray(axes, dtype=object)))
        if len(own) != len(heights_in) or not all(isinstance(place, Place) for place in own):
            kinds = ", ".join(type(place).__name__ for place in own) or "none"
            raise ProblemError(
                f"axes must be {len(heights_in)} matplotlib Axes, one per panel; got {len(own)} "
                f"({kinds})."
            )
        return own
    rows = [max(heights_in[i : i + columns]) for i in range(0, len(heights_in), columns)]
    figure = Figure(figsize=(_WIDTH_IN, sum(rows) + _AROUND_IN * len(rows)), layout="constrained")
    grid = figure.add_gridspec(len(rows), columns, height_ratios=rows)
    return [figure.add_subplot(grid[divmod(i, columns)]) for i in range(len(heights_in))]


def _legend_entries(panels: Sequence[Panel]) -> tuple[list[Any], list[str]]:
    """Return marks and texts of a legend, each name with the first mark that has it."""
    entries: dict[str, Any] = {}
    for panel in panels:
        for mark, name in zip(*panel.axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, mark)
    return list(entries.values()), [shorten(name, _LONGEST["name"]) for name in entries]


def _draw_legend(figure: Figure, panels: Sequence[Panel], height: float) -> None:
    """Draw the legend above the panels, and give the figure its height without it [inch]."""
    marks, names = _legend_entries(panels)
    if names:
        widest = 0.55 + _LETTER_IN * max(map(len, names))
        columns = int(max(1, min(len(names), (_WIDTH_IN - 0.2) // widest)))
        place: dict[str, Any] = {"loc": "outside upper center", "ncols": columns}
        figure.legend(marks, names, handlelength=3.2, **place)
        height += 0.12 + 0.165 * -(-len(names) // columns)
    figure.set_size_inches(_WIDTH_IN, height)


def _draw_colour_bar(panels: Sequence[Panel], *, below: bool) -> bool:
    """Draw one colour bar for all maps, and return whether there are any."""
    mapped = [panel for panel in panels if panel.image is not None]
    if not mapped:
        return False
    image, places = mapped[0].image, [panel.axes for panel in mapped]
    lowest, highest = zip(*(panel.image.get_clim() for panel in mapped), strict=True)
    for panel in mapped:  # one scale for all
        panel.image.set_clim(min(lowest), max(highest))
        panel.draw_contours()
    style: dict[str, Any] = {"location": "bottom", "shrink": 0.6, "aspect": 40} if below else {}
    bar = mapped[0].figure.colorbar(image, ax=places, **style)
    bar.set_label(mapped[0].image_text)
    bar.outline.set_visible(False)
    return True


class Panel:
    """Axes that a part of a figure is drawn on.

    A mark with a name is in the legend, once for each name. A look is the number of a colour with
    its dashes and marker; None is dark grey.
    """

    def __init__(self, axes: Axes) -> None:
        self.axes = axes
        self.image: Any = None  # of a map
        self.image_text = ""
        self._levels: tuple[FloatArray, FloatArray, Any] | None = None  # of contours
        self.series: list[Series] = []
        self.title_lines = 0
        self._title = ""
        self._axis: dict[str, dict[str, Any]] = {}
        self._flags: tuple[FloatArray, FloatArray, Sequence[str]] = np.zeros(0), np.zeros(0), ()
        self.is_equal = False
        axes.margins(x=0, y=_ROOM)
        self.set_axes({}, {})

    @property
    def figure(self) -> Figure:
        """The figure that the axes are in."""
        return self.axes.figure

    def set_axes(
        self, x: Mapping[str, Any], y: Mapping[str, Any], *, title: str = "", equal: bool = False
    ) -> None:
        """Name the axes, before anything is drawn.

        Each has a label, and may have a unit ("-" of a pure number), ends (low, high), and a
        logarithmic scale (log), on which nothing is drawn that is not positive.
        """
        for name, axis in (("x", x), ("y", y)):
            unit, factor = shown_unit(axis.get("unit", ""))
            text = axis.get("label", "")
            ends = (axis.get("low"), axis.get("high"))
            self._axis[name] = {
                "text": f"{text} [{unit}]" if unit else text,
                "factor": factor,
                "log": axis.get("log", False),
                "ends": [None if end is None else factor * end for end in ends],
            }
            getattr(self.axes, f"set_{name}scale")("log" if axis.get("log") else "linear")
        self._title = title
        self.is_equal = equal

    def _shown(self, name: str, values: ArrayLike) -> FloatArray:
        """Return values of an axis in the unit that is shown."""
        return np.asarray(self._axis[name]["factor"] * np.asarray(values, dtype=np.float64))

    def curve(
        self,
        name: str,
        x: ArrayLike,
        y: ArrayLike,
        *,
        look: int | None = 0,
        line: bool = True,
        dash: int | None = None,
        width: float = 1.6,
        opacity: float = 1.0,
        marker: str | None = None,
        filled: bool = True,
        size: float = 5.0,
        step: str = "default",
        error: ArrayLike | None = None,
        quiet: bool = False,
        numbers: bool = True,
    ) -> None:
        """Draw points, (n,) each, joined by a line or not; nan breaks the line.

        Without a name, or without ``numbers``, it is a guide to the eye that is in no table; a
        quiet one is in tables but not in the legend, one without points in the legend only. A
        marker is one of matplotlib's, or "own" for that of the look; ``dash`` is the number of its
        dashes, 0 is solid and None that of the look. Sizes and widths are in points, ``error`` are
        half lengths of error bars.
        """
        along, up = self._shown("x", x), self._shown("y", y)
        strokes, shade = dashes(look if dash is None else dash), colour(look)
        style: dict[str, Any] = {"color": shade, "linewidth": width}
        style["linestyle"] = ((0, strokes) if strokes else "-") if line else "none"
        if opacity < 1:
            style["alpha"] = opacity
        if marker is not None:
            style |= {"marker": marker_of(look) if marker == "own" else marker, "markersize": size}
            style |= {"markerfacecolor": shade if filled else "none"}
            style |= {"markeredgewidth": 0.4 if filled and line else 1.2}
            self.axes.margins(x=_ROOM)
        label = f"_{name}" if quiet else _label(name)
        self.axes.plot(along, up, drawstyle=step, label=label, **style)
        if error is not None:
            half = self._shown("y", error)
            self.axes.vlines(along, up - half, up + half, color=shade, linewidth=1.0)
        if name and numbers and along.size:
            self._note(name, along, up)

    def _note(self, name: str, x: FloatArray | tuple[str, ...], y: FloatArray) -> None:
        heading, title = self._axis["x"]["text"], self._axis["y"]["text"]
        if self._title:
            title = f"{self._title}: {title}" if title else self._title
        self.series.append(Series(panel=title, heading=heading, name=name, x=x, y=y))

    def area(
        self, name: str, x: ArrayLike, low: ArrayLike, high: ArrayLike, *, look: int | None = 0
    ) -> None:
        """Shade the area between two curves, (n,) each."""
        along, least, most = self._shown("x", x), self._shown("y", low), self._shown("y", high)
        self.axes.fill_between(along, least, most, label=_label(name), **_fill_style(look))
        if name:
            self._note(f"{name}, from", along, least)
            self._note(f"{name}, to", along, most)

    def rule(self, name: str, at: float, axis: str = "x", *, dash: int = 0) -> None:
        """Draw a straight grey line across the panel at a value of an axis, below the curves."""
        place = self._shown(axis, [at])
        draw = self.axes.axvline if axis == "x" else self.axes.axhline
        strokes = _DASHES[dash]
        style = {"color": GREY, "linewidth": 1.0, "linestyle": (0, strokes) if strokes else "-"}
        draw(place[0], zorder=1.6, label=_label(name), **style)

    def span(
        self, name: str, low: float, high: float, axis: str = "x", *, look: int | None = None
    ) -> None:
        """Shade a range of an axis, from end to end of the other."""
        ends = self._shown(axis, [low, high])
        shade = self.axes.axvspan if axis == "x" else self.axes.axhspan
        shade(ends[0], ends[1], label=_label(name), **_fill_style(look))

    def bars(
        self,
        categories: Sequence[str],
        bars: Mapping[str, ArrayLike],
        intervals: Mapping[str, tuple[ArrayLike, ArrayLike]],
    ) -> None:
        """Draw bars of each name along x, (c,), one per category from the top; nan draws none.

        ``intervals`` are ends around the values of a name.
        """
        places, height = np.arange(len(categories)), 0.8 / len(bars)
        for look, (name, lengths) in enumerate(bars.items()):
            values, up = self._shown("x", lengths), places + (look - (len(bars) - 1) / 2) * height
            drawn, shade = np.isfinite(values), colour(look)
            size = 0.9 * height
            self.axes.barh(up[drawn], values[drawn], height=size, color=shade, label=_label(name))
            if name in intervals:
                ends = [self._shown("x", end) for end in intervals[name]]
                self.axes.hlines(up, *ends, color="black", linewidth=1.0)
            self._note(f"{name} {self._axis['x']['text']}", tuple(categories), values)
        names = [shorten(name, _LONGEST["category"]) for name in categories]
        self.axes.set_yticks(places, names)
        self.axes.set_ylim(len(names) - 0.4, -0.6)
        self.axes.margins(x=_ROOM)
        self.axes.tick_params(axis="y", length=0)
        self.axes.grid(visible=False, axis="y")

    def flags(self, x: ArrayLike, y: ArrayLike, texts: Sequence[str]) -> None:
        """Write upright texts along the upper edge, each with a line down to its point; x rises."""
        self._flags = self._shown("x", x), self._shown("y", y), texts

    def map(
        self,
        x: FloatArray,
        y: FloatArray,
        values: FloatArray,
        label: str,
        unit: str = "",
        *,
        log: bool = False,
        contours: bool = False,
        blank: str = "no value",
    ) -> None:
        """Draw values (ny, nx) over a grid of increasing centres, nan hatched as ``blank``.

        Contours are lines of equal, round values.
        """
        from matplotlib.colors import LogNorm, Normalize

        along, up = self._shown("x", x), self._shown("y", y)
        edges, shown = (_cell_edges(along), _cell_edges(up)), np.ma.masked_invalid(values)
        self.axes.grid(visible=False)
        self.axes.margins(0)
        ends = (np.nanmin(values), np.nanmax(values)) if shown.count() else (0.0, 1.0)
        norm = (LogNorm if log else Normalize)(*ends)
        self.image = self.axes.pcolormesh(*edges, shown, cmap="viridis", norm=norm, rasterized=True)
        self.image_text = f"{label} [{unit}]" if unit else label
        if contours and min(values.shape) > 1 and np.ptp(shown.compressed()) > 0:
            self._levels = along, up, shown
        if np.any(np.isnan(values)):  # what no cell covers
            self.axes.patch.set(**_BLANK)
            corner = [edges[0][0]] * 2, edges[1][0], edges[1][0]
            self.axes.fill_between(*corner, label=_label(blank), **_BLANK)
        for place, row in zip(up, values, strict=True):
            self._note(f"{label} at {self._axis['y']['text']} {place:g}", along, row)

    def draw_contours(self) -> None:
        """Draw lines of equal, round values over a map, light where it is dark."""
        from matplotlib.colors import ListedColormap

        if self._levels is not None:
            style = {"cmap": ListedColormap(["white", "black"]), "norm": self.image.norm}
            lines = self.axes.contour(*self._levels, _CONTOURS, linewidths=0.8, **style)
            self.axes.clabel(lines, fmt="%g", fontsize=7, inline_spacing=3)

    def finish(self) -> None:
        """Set the scales and their ticks, and write the title."""
        from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

        for name, place in (("x", self.axes.xaxis), ("y", self.axes.yaxis)):
            axis = self._axis[name]
            (first, last), (low, high) = axis["ends"], getattr(self.axes, f"get_{name}lim")()
            low, high = low if first is None else first, high if last is None else last
            if axis["log"]:
                low = max(low, high / _MOST_RATIO)
                subs = (1, 2, 5) if high < _FEW_DECADES * low else (1,)
                linear, decades = MaxNLocator(7, steps=[1, 2, 5, 10]), LogLocator(subs=subs)
                place.set_major_locator(linear if high < 10 * low else decades)
                place.set_major_formatter("{x:g}")
                place.set_minor_locator(NullLocator())
            if first is not None and high <= low:  # all values are below the end that is given
                high = low + 1
            getattr(self.axes, f"set_{name}lim")(low, high)
            place.set_label_text(axis["text"], parse_math=False)
        width_in = self.axes.get_window_extent().width / self.axes.figure.dpi
        self._draw_flags(width_in)
        letters = max(12, int(width_in / _LETTER_IN))
        lines = textwrap.wrap(shorten(self._title, 3 * letters), letters)
        self.title_lines = len(lines)
        self.axes.set_title("\n".join(lines), loc="left", parse_math=False)

    def _draw_flags(self, width_in: float) -> None:
        """Draw upright texts without overlaps on axes of a width."""
        x, y, texts = self._flags
        if not texts:
            return
        points = self.axes.transData.transform(np.column_stack((x, y)))
        across = self.axes.transAxes.inverted().transform(points)[:, 0]
        places = spread_labels(across, _FLAG_IN / width_in)
        line = {"arrowstyle": "-", "color": "0.6", "linewidth": 0.5, "relpos": (0.5, 0.0)}
        for text, point, place in zip(texts, zip(x, y, strict=True), places, strict=True):
            self.axes.annotate(
                text,
                xy=point,
                xytext=(float(place), 0.985),
                textcoords="axes fraction",
                fontsize=6.5,
                rotation=90,
                ha="center",
                va="top",
                color="0.15",
                arrowprops={**line, "shrinkA": 0, "shrinkB": 0},
            )


def shorten(text: str, most: int) -> str:
    """Return a text of at most so many characters, with its middle left out if need be."""
    if len(text) <= most:
        return text
    return f"{text[: most // 2]}…{text[len(text) - (most - 1) // 2 :]}"


def spread_labels(places: FloatArray, width: float) -> FloatArray:
    """Return places in (0, 1) for labels of that width near increasing ones; none overlap."""
    gap = min(width, 1 / max(places.size, 1))
    steps = gap * np.arange(places.size)
    least = gap / 2 + steps
    # pushed to the right where they are crowded, and back from the end
    right = np.maximum.accumulate(np.maximum(places, least) - steps) + steps
    ends = 1 - least[::-1]
    return np.asarray(np.minimum.accumulate((np.minimum(right, ends) - steps)[::-1])[::-1] + steps)


def _cell_edges(centres: FloatArray) -> FloatArray:
    """Return the ends of the cells of increasing values, halfway between them."""
    if centres.size == 1:
        return np.array([centres[0] - 0.05, centres[0] + 0.05])
    middle = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def _label(name: str) -> str:
    """Return a label of a legend; without the space, a leading underscore would leave it out."""
    return f" {name}" if name.startswith("_") else name


def _fill_style(look: int | None) -> dict[str, Any]:
    return {"color": colour(look), "alpha": _SHADE, "linewidth": 0}


def draw_bars(
    axis: Mapping[str, Any],
    categories: Sequence[str],
    bars: Mapping[str, ArrayLike],
    intervals: Mapping[str, tuple[ArrayLike, ArrayLike]],
) -> Figure:
    """Draw bars of each name along an axis, one per category, and intervals around some."""
    height_in = 0.2 + _BAR_IN * max(2, len(categories) * len(bars))
    with drawing([min(height_in, _HIGHEST_IN)]) as (panel,):
        panel.set_axes(axis, {})
        panel.bars(categories, bars, intervals)
    return panel.figure


def count_columns(panels: int) -> int:
    """Return how many panels stand side by side: three, but two if there are four."""
    return 2 if panels == 4 else min(panels, 3)


def square_in(columns: int) -> float:
    """Return the height of square axes, so many side by side [inch]."""
    return min(_WIDTH_IN / columns - 0.75, 5.0)
