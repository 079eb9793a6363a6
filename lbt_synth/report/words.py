"""Numbers as people read them."""

from __future__ import annotations

import math
from collections.abc import Sequence


def number_text(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits: 27.7, 0.4512, ∞, –."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value != 0 and not 1e-4 <= abs(value) < 1e7:
        mantissa, power = f"{value:.{max(digits - 2, 0)}e}".split("e")
        return f"{mantissa}e{int(power)}".replace("-", "−")
    text = f"{value:.{digits}g}"
    if "e" in text:
        text = f"{value:.0f}"
    return text.replace("-", "−")


def fixed_text(value: float, decimals: int) -> str:
    """Return a number with so many decimals, a dash where there is none."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def signed_text(value: float, digits: int = 4) -> str:
    """Return a number with its sign: +0.5, −3, 0."""
    text = number_text(value, digits)
    return f"+{text}" if value > 0 else text


def interval_text(low: float, high: float, digits: int = 4) -> str:
    """Return an interval as a text: 0.24 to 1.82."""
    return f"{number_text(low, digits)} to {number_text(high, digits)}"


def listing_text(items: Sequence[str]) -> str:
    """Return a list as a part of a sentence: a, b and c."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} and {items[-1]}"
