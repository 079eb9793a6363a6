"""Colours, dashes and markers, the same on paper and on the screen."""

from __future__ import annotations

from lbt_synth.report.figures.style import COLOURS

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
_OWN = ("circle", "square", "triangle", "diamond", "plus", "cross")


def colour(look: int | None) -> str:
    """Colour of a look, as #rrggbb."""
    return GREY if look is None else COLOURS[look % len(COLOURS)]


def dashes(look: int | None) -> tuple[float, ...]:
    """Strokes and gaps of a look [widths of the line]; () is solid.

    Where the colours begin anew, they meet other dashes.
    """
    if look is None:
        return ()
    return _DASHES[(look + look // len(COLOURS)) % len(_DASHES)]


def marker_name(marker: str, look: int | None) -> str:
    """Name of a marker; "own" is that of the look."""
    if marker != "own":
        return marker
    return "circle" if look is None else _OWN[(look + look // len(COLOURS)) % len(_OWN)]
