"""Colours, dashes and markers that differ in grey and for the colour-blind."""

from __future__ import annotations

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
