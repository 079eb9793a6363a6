"""Numbers, lists and durations as parts of a sentence."""

from __future__ import annotations

from collections.abc import Sequence


def count_text(number: int, word: str, words: str = "") -> str:
    """Return a number of things: 1 state, 2 states; ``words`` are several of an odd one."""
    return f"{number} {word if number == 1 else words or f'{word}s'}"


def listing_text(items: Sequence[str]) -> str:
    """Return a list as a part of a sentence: a, b and c."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} and {items[-1]}"


def duration_text(seconds: float) -> str:
    """Return a duration in the unit that suits it: 12.5 s, 3.2 min, 7 h, 5.1 days."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 6000:
        return f"{seconds / 60:.3g} min"
    hours = seconds / 3600
    return f"{hours:.3g} h" if hours < 100 else f"{hours / 24:.3g} days"
