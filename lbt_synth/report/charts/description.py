"""What a figure shows, whoever draws it: panels with axes, curves, areas, bars and maps.

A description knows no drawing library. ``matplotlib_charts`` draws it for files and
``bokeh_charts`` for pages, both from the same numbers and limits.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeVar

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.validation import FloatArray, choice, float_array, frozen_copy, set_fields

# Okabe and Ito's palette, in an order that also darkens and lightens in grey
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY = "#404040"
SHADE = 0.2  # opacity of shaded areas
PALE = "#d9d9d9"
# Lengths of strokes and gaps, in widths of the line
_DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (4, 2),
    (6, 2, 1, 2),
    (1.2, 1.6),
    (6, 1.5, 1, 1.5, 1, 1.5),
    (2.5, 1.5),
)
MARKERS = ("circle", "square", "triangle", "diamond", "plus", "cross")


def colour(look: int | None) -> str:
    """Colour of a look, as #rrggbb; None is grey."""
    return GREY if look is None else _COLOURS[look % len(_COLOURS)]


def dashes(look: int | None) -> tuple[float, ...]:
    """Strokes and gaps of a look [widths of the line]; () is solid."""
    return () if look is None else _DASHES[_turned(look)]


def marker_name(marker: str, look: int | None) -> str:
    """Name of a marker; "own" stands for that of the look."""
    return marker if marker != "own" else MARKERS[0 if look is None else _turned(look)]


def _turned(look: int) -> int:
    """Return the number of dashes or marker; where the colours repeat, it differs."""
    return (look + look // len(_COLOURS)) % len(_DASHES)


_KEY = re.compile(r"[a-z][a-z0-9-]*")


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """An axis of a panel."""

    label: str  # What is on it
    unit: str = ""  # Its unit; empty for a name without one, "-" for a pure number
    log: bool = False  # Whether its scale is logarithmic; what is not positive is then not drawn
    low: float | None = None  # Lower end of the scale; by default that of what is drawn
    high: float | None = None  # Its upper end

    @property
    def text(self) -> str:
        """Label and unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


# Every mark has a name for the legend. An empty name is not in the legend; marks with the same name
# are one entry. A look is the number of a colour with its dashes and marker; None is dark grey.


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """Points, joined by a line or not."""

    name: str
    # (n,): the points; nan breaks the line. Empty for a name that is in the legend only.
    x: FloatArray
    y: FloatArray
    error: FloatArray | None = None  # (n,): half lengths of vertical error bars; nan draws none
    look: int | None = 0
    line: bool = True  # Whether the points are joined
    # "after": each value holds until the next point; "center": around its point
    step: str | None = None
    marker: str | None = None  # "own" for that of the look, or one of MARKERS
    filled: bool = True  # Whether markers are filled
    size: float = 5.0  # Size of a marker [points]
    width: float = 1.6  # Width of the line [points]
    opacity: float = 1.0  # Below 1 a line shows what is under it
    dash: int | None = None  # Number of its dashes, 0 is solid; None is that of its look
    hover: bool = True  # Whether its values are shown under the pointer

    def __post_init__(self) -> None:
        _take_columns(self, "x", "y", "error")
        if self.step is not None:
            choice(self.step, "step", ("after", "center"))
        if self.marker is not None:
            choice(self.marker, "marker", ("own", *MARKERS))
        if not self.line and self.marker is None:
            raise ProblemError("a curve must have a line or a marker; got neither.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Area:
    """The area between two curves: an interval of confidence, a spread, a histogram."""

    name: str
    x: FloatArray  # (n,)
    low: FloatArray  # (n,): lower edge
    high: FloatArray  # (n,): upper edge
    look: int | None = 0
    solid: bool = False  # Whether it hides what is below it

    def __post_init__(self) -> None:
        _take_columns(self, "x", "low", "high")


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """A straight grey line across a panel, below its curves."""

    name: str
    at: float  # Where it is
    axis: str = "x"  # "x" or "y": the axis that ``at`` is a value of
    dash: int = 0  # Number of its dashes

    def __post_init__(self) -> None:
        choice(self.axis, "axis", ("x", "y"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """A shaded range of an axis, from end to end of the other."""

    name: str
    low: float
    high: float
    axis: str = "x"  # "x" or "y": the axis that these are values of
    look: int | None = None

    def __post_init__(self) -> None:
        choice(self.axis, "axis", ("x", "y"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bars:
    """Bars along x, one per category of the panel, from the top; several series stand in groups."""

    name: str
    values: FloatArray  # (c,): lengths; nan draws none
    low: FloatArray | None = None  # (c,): lower end of an interval around each value
    high: FloatArray | None = None  # (c,): its upper end
    look: int | None = 0

    def __post_init__(self) -> None:
        _take_columns(self, "values", "low", "high")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flags:
    """Upright texts along the upper edge of a panel, each with a line down to its point."""

    x: FloatArray  # (n,): increasing
    y: FloatArray  # (n,)
    texts: tuple[str, ...]  # n of them
    name: str = ""

    def __post_init__(self) -> None:
        _take_columns(self, "x", "y")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Map:
    """Values over a grid, as colours."""

    x: FloatArray  # (nx,): increasing centres of the cells
    y: FloatArray  # (ny,): the same
    values: FloatArray  # (ny, nx): what is shown; nan is hatched
    label: str  # What the values are
    unit: str = ""  # Their unit
    low: float = 0.0  # Lower end of the colour scale
    high: float = 1.0  # Its upper end
    log: bool = False  # Whether the colour scale is logarithmic
    levels: tuple[float, ...] = ()  # Where lines of equal value are drawn
    blank: str = "no value"  # What a hatched cell means

    def __post_init__(self) -> None:
        for name in ("x", "y", "values"):
            set_fields(self, **{name: frozen_copy(float_array(getattr(self, name), name))})
        if self.values.shape != (self.y.size, self.x.size) or not self.values.size:
            raise DimensionError(
                f"values must have a row for each of {self.y.size} y and a column for each of "
                f"{self.x.size} x; got {self.values.shape}."
            )
        for name in ("x", "y"):
            if np.any(np.diff(getattr(self, name)) <= 0):
                raise ProblemError(f"{name} of a map must increase; it does not.")
        if not self.low < self.high:
            raise ProblemError(f"low must be below high; got {self.low:g} and {self.high:g}.")

    @property
    def name(self) -> str:
        """What the legend calls its hatched cells; empty if there are none."""
        return self.blank if np.any(np.isnan(self.values)) else ""

    @property
    def text(self) -> str:
        """Label and unit of the values."""
        return Axis(label=self.label, unit=self.unit).text


Mark: TypeAlias = Curve | Area | Rule | Span | Bars | Flags | Map
Kind = TypeVar("Kind", Curve, Area, Rule, Span, Bars, Flags, Map)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panel:
    """One pair of axes and what is drawn in them, the first things at the bottom.

    Axes in nm become axes in the unit that is shown.
    """

    x: Axis  # The axis along the bottom
    y: Axis  # The axis along the left
    marks: tuple[Mark, ...]
    title: str = ""  # What distinguishes this panel from the others of its figure
    categories: tuple[str, ...] = ()  # Names along y, from the top, for bars
    equal: bool = False  # Whether both axes have the same scale
    height_in: float | None = None  # Height of the axes on paper [inch]

    def __post_init__(self) -> None:
        x, along = _shown_axis(self.x)
        y, up = _shown_axis(self.y)
        marks = tuple(_rescale(mark, along, up) for mark in self.marks)
        set_fields(self, x=x, y=y, marks=marks, categories=tuple(self.categories))
        for bars in self.select(Bars):
            if bars.values.size != len(self.categories):
                raise DimensionError(
                    f"bars must have a value for each of {len(self.categories)} categories; got "
                    f"{bars.values.size}."
                )

    def select(self, kind: type[Kind]) -> list[Kind]:
        """Return the marks of one kind."""
        return [mark for mark in self.marks if isinstance(mark, kind)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart:
    """A figure of a page: one or several panels, with its words."""

    key: str  # Its anchor in the page: small letters, digits and hyphens; unique in the page
    title: str  # A short heading
    caption: str  # What is seen and how to read it
    alt: str  # The same for those who do not see it: what is drawn, and what it shows
    panels: tuple[Panel, ...]  # The panels, row by row
    columns: int = 1  # Panels side by side, where there is room

    def __post_init__(self) -> None:
        set_fields(self, panels=tuple(self.panels))
        require_key(self.key)
        for name in ("title", "caption", "alt"):
            if not getattr(self, name).strip():
                raise ProblemError(f"a chart must have words for its {name}; got none.")
        if not self.panels or self.columns < 1:
            raise ProblemError("a chart must have at least one panel and one column.")


def _shown_axis(axis: Axis) -> tuple[Axis, float]:
    """Return an axis in the unit that is shown, and the factor to it."""
    unit, factor = shown_unit(axis.unit)
    if factor == 1:
        return axis, factor
    low, high = (None if end is None else factor * end for end in (axis.low, axis.high))
    return replace(axis, unit=unit, low=low, high=high), factor


def _rescale(mark: Mark, along: float, up: float) -> Mark:
    """Return a mark with its places along x and up y multiplied by factors."""
    factors = dict.fromkeys(("x", "values") if isinstance(mark, Bars) else ("x",), along)
    factors |= dict.fromkeys(("y", "error"), up)
    if isinstance(mark, Rule | Span):
        factors |= dict.fromkeys(("at", "low", "high"), along if mark.axis == "x" else up)
    elif isinstance(mark, Map):
        unit, depth = shown_unit(mark.unit)
        factors |= dict.fromkeys(("values", "low", "high", "levels"), depth)
        mark = replace(mark, unit=unit)
    else:
        factors |= dict.fromkeys(("low", "high"), along if isinstance(mark, Bars) else up)
    scaled: Any = {
        name: tuple(factor * each for each in value) if isinstance(value, tuple) else factor * value
        for name, factor in factors.items()
        if factor != 1 and (value := getattr(mark, name, None)) is not None
    }
    return replace(mark, **scaled) if scaled else mark


def require_key(key: str) -> str:
    """Refuse what cannot be an anchor."""
    if not _KEY.fullmatch(key):
        raise ProblemError(
            f"a key must be of small letters, digits and hyphens, and start with a letter; "
            f"got {key!r}."
        )
    return key


def _take_columns(mark: Mark, *names: str) -> None:
    """Make those columns of a mark that are given read-only arrays of the same length."""
    given = {name: getattr(mark, name) for name in names if getattr(mark, name) is not None}
    columns = {name: frozen_copy(float_array(value, name)) for name, value in given.items()}
    shapes = {column.shape for column in columns.values()}
    if len(shapes) != 1 or len(shapes.pop()) != 1:
        listing = ", ".join(f"{name} {column.shape}" for name, column in columns.items())
        raise DimensionError(f"columns of a mark must be lists of the same length; got {listing}.")
    set_fields(mark, **columns)
