"""Lines of text broken to a width, measured in the font that they are set in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

_POINTS = 72.0


@dataclass(frozen=True, slots=True)
class Style:
    """Size [points], weight, family and colour of a text."""

    size: float
    weight: str = "normal"
    family: str = "sans-serif"
    ink: str = "#1b1f24"

    @property
    def leading(self) -> float:
        """Distance of lines [inch]."""
        return 1.35 * self.size / _POINTS


BODY = Style(9)
BOLD = Style(9, weight="bold")
LINE = Style(8)
MONO = Style(7, family="monospace")


def text_width(text: str, style: Style) -> float:
    """Width of a text [inch]."""
    return (
        sum(_word_width(part, style.weight, style.family) for part in _split_words(text))
        * style.size
    )


def _split_words(text: str) -> list[str]:
    """Split a text into words and spaces, whose widths are cached."""
    words = text.split(" ")
    return [part for word in words for part in (word, " ")][:-1]


@lru_cache(maxsize=20_000)
def _word_width(part: str, weight: str, family: str) -> float:
    """Width of a word [inch] at one point."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    if not part:
        return 0.0
    size = 100.0
    font = FontProperties(family=family, weight=weight, size=size)
    width, _, _ = text_to_path.get_text_width_height_descent(part, font, ismath=False)
    return float(width) / size / _POINTS


def wrap(text: str, style: Style, width: float) -> list[str]:
    """Break a text into lines of at most a width [inch]; longer words are broken, too."""
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            joined = f"{line} {word}" if line else word
            if text_width(joined, style) <= width:
                line = joined
                continue
            if line:
                lines.append(line)
            line = word
            while text_width(line, style) > width and len(line) > 1:
                fits = _count_fitting(line, style, width)
                lines.append(line[:fits])
                line = line[fits:]
        lines.append(line)
    return lines


def _count_fitting(word: str, style: Style, width: float) -> int:
    """Return how many letters of a word fit, at least one."""
    low, high = 1, len(word)
    while low < high:
        middle = (low + high + 1) // 2
        if text_width(word[:middle], style) <= width:
            low = middle
        else:
            high = middle - 1
    return low


def mono_lines(text: str, width: float) -> list[str]:
    """Break a listing into lines; those that are too long continue on the next line."""
    letters = max(8, int(width / text_width("m", MONO)))
    lines: list[str] = []
    for line in text.expandtabs(4).splitlines():
        rest = line
        while len(rest) > letters:
            lines.append(rest[:letters])
            rest = "    " + rest[letters:]
        lines.append(rest)
    return lines
