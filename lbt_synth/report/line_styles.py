"""Colours, dashes and markers that differ in grey and for the colour-blind."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import Any

# Okabe and Ito's palette, in an order that also darkens and lightens in grey
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (3, 1)))
MARKERS = ("o", "s", "^", "D", "v", "P")
GREY = "#404040"
PALE = "#d9d9d9"
# lengths of strokes and gaps, in widths of the line
_DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (4, 2),
    (6, 2, 1, 2),
    (1.2, 1.6),
    (6, 1.5, 1, 1.5, 1, 1.5),
    (2.5, 1.5),
)
MARKER_NAMES = ("circle", "square", "triangle", "diamond", "cross", "plus")
_OWN_MARKERS = ("circle", "square", "triangle", "diamond", "plus", "cross")


def line_styles() -> Iterator[dict[str, Any]]:
    """Styles of matplotlib without end, each with its own colour and dashes."""
    for colour, line in cycle(zip(COLOURS, LINES, strict=True)):
        yield {"color": colour, "linestyle": line}


def colour(look: int | None) -> str:
    """Colour of a look, as #rrggbb; None is grey."""
    return GREY if look is None else COLOURS[look % len(COLOURS)]


def dashes(look: int | None) -> tuple[float, ...]:
    """Strokes and gaps of a look [widths of the line]; () is solid.

    Where the colours repeat, the dashes differ.
    """
    if look is None:
        return ()
    return _DASHES[(look + look // len(COLOURS)) % len(_DASHES)]


def marker_name(marker: str, look: int | None) -> str:
    """Name of a marker; "own" stands for that of the look."""
    if marker != "own":
        return marker
    return (
        "circle"
        if look is None
        else _OWN_MARKERS[(look + look // len(COLOURS)) % len(_OWN_MARKERS)]
    )
