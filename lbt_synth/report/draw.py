"""How every figure is drawn: axes with the looks of the house, on a new figure or the user's own.

A figure is a block of :func:`drawing`, which yields matplotlib's axes and at its end sets ticks,
titles and the legend. Curves have labels; what guides the eye is drawn below them, in grey.
Numbers in nm are drawn in the unit that is shown.
"""

from __future__ import annotations

import io
import os
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

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
_MARKERS = "os^D+x"
# what guides the eye: below the curves, and in no table of numbers
GUIDE: dict[str, Any] = {"color": GREY, "linewidth": 1.0, "zorder": 1.6}
_CURVES = 2.0  # zorder of matplotlib's lines
SHADE: dict[str, Any] = {"alpha": 0.2, "linewidth": 0}
_BLANK: dict[str, Any] = {
    "facecolor": "#d9d9d9",
    "edgecolor": "0.55",
    "hatch": "////",
    "linewidth": 0,
}
PANEL_IN = 2.1  # height of a panel, unless it says another
_WIDTH_IN = 7.0  # of a figure
_LETTER_IN = 0.068  # width of a letter at 8 points, generously
_AROUND_IN = 0.55  # below and above the axes of a panel
_LONGEST = 60  # letters of a name in the legend


def colour(look: int | None) -> str:
    """Colour of a look, as #rrggbb; None is grey."""
    return GREY if look is None else _COLOURS[look % len(_COLOURS)]


def dashes(look: int | None) -> tuple[float, ...]:
    """Strokes and gaps of a look [widths of the line]; () is solid."""
    # where the colours repeat, dashes and markers are others
    return () if look is None else _DASHES[(look + look // len(_COLOURS)) % len(_DASHES)]


def line_style(look: int | None, *, dash: int | None = None, **style: Any) -> dict[str, Any]:
    """Return how a curve of a look is drawn; ``dash`` is the look of its dashes, 0 is solid."""
    strokes = dashes(look if dash is None else dash)
    return {"color": colour(look), "linestyle": (0, strokes) if strokes else "-", **style}


def dot_style(look: int, **style: Any) -> dict[str, Any]:
    """Return how the points of a curve of a look are drawn, joined by its line."""
    marker = _MARKERS[(look + look // len(_COLOURS)) % len(_MARKERS)]
    return line_style(look, marker=marker, markersize=4.0, **style)


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib settings of this package, for the time of the block."""
    import matplotlib as mpl

    style = files("lbt_synth.report") / "house.mplstyle"
    # a name in a script that the font does not have stays a name
    with mpl.rc_context(fname=str(style)), ignore_warnings(message=r"Glyph .* missing"):
        yield


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure, whole or not at all."""
    target = require_ending(path, "a figure", FIGURE_ENDINGS)
    ending = target.suffix.lower()
    buffer = io.BytesIO()
    # without a date, the same figure is the same file
    undated: dict[str, dict[str, Any]] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
    with house_style():
        figure.savefig(buffer, format=ending[1:], metadata=undated.get(ending))
    return write_atomically(target, buffer.getvalue())


@contextmanager
def drawing(
    heights_in: Sequence[float], *, columns: int = 1, axes: OwnAxes = None
) -> Iterator[list[Axes]]:
    """Yield axes for each height [inch], row by row; set ticks, titles and the legend at the end.

    They are those of a new figure, or the user's own.
    """
    from matplotlib.axes import Axes as Place
    from matplotlib.figure import Figure

    with house_style():
        if axes is None:
            rows = [max(heights_in[i : i + columns]) for i in range(0, len(heights_in), columns)]
            height = sum(rows) + _AROUND_IN * len(rows)
            figure = Figure(figsize=(_WIDTH_IN, height), layout="constrained")
            grid = figure.add_gridspec(len(rows), columns, height_ratios=rows)
            places = [figure.add_subplot(grid[divmod(i, columns)]) for i in range(len(heights_in))]
        else:
            places = list(np.ravel(np.asarray(axes, dtype=object)))
            if len(places) != len(heights_in) or not all(isinstance(p, Place) for p in places):
                kinds = ", ".join(type(place).__name__ for place in places) or "none"
                raise ProblemError(
                    f"axes must be {len(heights_in)} matplotlib Axes, one per panel; got "
                    f"{len(places)} ({kinds})."
                )
        yield places
        letters = int(_WIDTH_IN / _LETTER_IN / columns) - 8
        for place in places:
            _set_ticks(place)
            title = shorten(place.get_title(loc="left"), 3 * letters)
            place.set_title(textwrap.fill(title, letters), loc="left")
        if axes is None:
            _draw_legend(places[0].figure, places)
        else:
            for place in places:
                _draw_legend(place, [place])


def _set_ticks(axes: Axes) -> None:
    """Put plain numbers at round places of logarithmic scales."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            low, high = axis.get_view_interval()
            subs = (1, 2, 5) if high < 150 * low else (1,)
            linear, decades = MaxNLocator(7, steps=[1, 2, 5, 10]), LogLocator(subs=subs)
            axis.set_major_locator(linear if high < 10 * low else decades)
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())


def _draw_legend(place: Any, panels: Sequence[Axes]) -> None:
    """Draw the legend of panels on one of them, or above all and make the figure as much higher."""
    entries: dict[str, Any] = {}  # each name with the first mark that has it
    for panel in panels:
        for mark, name in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, mark)
    if not entries:
        return
    names, style = [shorten(name, _LONGEST) for name in entries], dict[str, Any]()
    if place not in panels:
        widest = 0.55 + _LETTER_IN * max(map(len, names))
        columns = int(max(1, min(len(names), (_WIDTH_IN - 0.2) // widest)))
        style = {"loc": "outside upper center", "ncols": columns}
        height = place.get_figheight() + 0.12 + 0.165 * -(-len(names) // columns)
        place.set_figheight(height)
    place.legend(entries.values(), names, handlelength=3.2, **style)


def name_axes(
    axes: Axes, x: tuple[str, str], y: tuple[str, str], title: str = "", **settings: Any
) -> tuple[float, float]:
    """Name axes by their labels and units, and return the factors to the units that are shown.

    A unit is "-" for a pure number. Settings are matplotlib's, such as ``yscale="log"``.
    """
    labels, factors = [], []
    for label, unit in (x, y):
        shown, factor = shown_unit(unit)
        labels.append(f"{label} [{shown}]" if shown else label)
        factors.append(factor)
    axes.set_title(title, loc="left")
    axes.set(xlabel=labels[0], ylabel=labels[1], **settings)
    return factors[0], factors[1]


def draw_map(
    panels: Sequence[Axes],
    grids: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
    label: str,
    *,
    blank: str = "no value",
    log: bool = False,
) -> None:
    """Draw x (nx,), y (ny,) and values (ny, nx) on each panel in one scale, nan as ``blank``."""
    from matplotlib.colors import LogNorm, Normalize

    finite = np.concatenate([values[np.isfinite(values)] for *_, values in grids])
    ends = (finite.min(), finite.max()) if finite.size else (0, 1)
    norm = (LogNorm if log else Normalize)(*ends)
    for panel, (along, up, values) in zip(panels, grids, strict=True):
        panel.grid(visible=False)
        panel.margins(0)
        style = {"cmap": "viridis", "norm": norm, "rasterized": True}
        mesh = panel.pcolormesh(along, up, np.ma.masked_invalid(values), **style)
        mesh.numbers = label, along, up, values  # for the tables of a page
        if np.any(np.isnan(values)):  # what no cell covers
            panel.patch.set(**_BLANK)
            panel.fill_between([], [], [], label=blank, **_BLANK)
    place = {"location": "bottom", "shrink": 0.6, "aspect": 40}
    bar = panels[0].figure.colorbar(mesh, ax=list(panels), **place)
    bar.ax.xaxis.set_major_formatter("{x:g}")
    bar.ax.xaxis.minorticks_off()
    bar.set_label(label)
    bar.outline.set_visible(False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """Numbers that a figure draws, in the units that are shown: a curve, or a row of a map."""

    panel: str  # title of its panel, and what is up its y axis
    heading: str  # what x is, with its unit
    name: str  # what y is
    x: FloatArray  # (n,)
    y: FloatArray  # (n,)


def figure_series(figure: Figure) -> Iterator[Series]:
    """Yield the numbers of the curves and maps of a figure."""
    for axes in figure.axes:
        names = " ".join(axes.get_title(loc="left").split()), axes.get_ylabel()
        panel, heading = ": ".join(filter(None, names)), axes.get_xlabel()
        for line in axes.get_lines():
            x, y = (np.asarray(values, dtype=np.float64) for values in line.get_data())
            if x.size and line.get_zorder() >= _CURVES:
                name = line.get_label().removeprefix("_")  # which keeps it out of the legend
                yield Series(panel=panel, heading=heading, name=name, x=x, y=y)
        for part in axes.collections:
            if (numbers := getattr(part, "numbers", None)) is not None:
                label, along, up, values = numbers
                for place, row in zip(up, values, strict=True):
                    name = f"{label} at {axes.get_ylabel()} {place:g}"
                    yield Series(panel=panel, heading=heading, name=name, x=along, y=row)


def shorten(text: str, most: int) -> str:
    """Return a text of at most so many characters, with its middle left out if need be."""
    if len(text) <= most:
        return text
    return f"{text[: most // 2]}…{text[len(text) - (most - 1) // 2 :]}"
