"""Numbers, lists and durations as parts of a sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def count_text(number: int, word: str, words: str = "") -> str:
    """Return a number of things: 1 state, 2 states; ``words`` are several of an odd one."""
    return f"{number} {word if number == 1 else words or f'{word}s'}"


def listing_text(items: Sequence[str], most: int = 0) -> str:
    """Return a list as a part of a sentence: a, b and c; with a limit also a, b and 7 others."""
    if 0 < most < len(items):
        items = [*items[: most - 1], f"{len(items) - most + 1} others"]
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} and {items[-1]}"


def unstable_text(names: Sequence[str]) -> str:
    """Return which loops are unstable, as a part of a sentence: a is, a and b are unstable."""
    return f"{listing_text(names, 3)} {'is' if len(names) == 1 else 'are'} unstable"


def rank_names(values: Mapping[str, float], least: str, most: str) -> dict[str, str]:
    """Return what is said after the names of values; of several the ends come first, with words."""
    ranked = sorted(values, key=values.__getitem__) if len(values) > 2 else []
    ends = dict(zip(ranked[:1] + ranked[-1:], (least, most), strict=False))
    return ends | {name: ends.get(name, "") for name in values}


def duration_text(seconds: float) -> str:
    """Return a duration in the unit that suits it: 12.5 s, 3.2 min, 7 h, 5.1 days."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 6000:
        return f"{seconds / 60:.3g} min"
    hours = seconds / 3600
    return f"{hours:.3g} h" if hours < 100 else f"{hours / 24:.3g} days"
