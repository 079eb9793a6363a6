"""Numbers as people read them."""

from __future__ import annotations

import math
import re

MINUS = "\u2212"  # as long as a plus
DASH = "\u2013"  # where there is no number
NO_BREAK = "\u00a0"


def number_text(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits: 27.7, 0.4512, ∞, –."""
    if math.isnan(value):
        return DASH
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    if value == 0:
        return "0"  # without the sign of rounding
    if not 1e-4 <= abs(value) < 1e7:
        mantissa, power = f"{value:.{max(digits - 1, 0)}e}".split("e")
        if "." in mantissa:
            mantissa = mantissa.rstrip("0").rstrip(".")
        return f"{mantissa}e{int(power)}".replace("-", MINUS)
    text = f"{value:.{digits}g}"
    if "e" in text:
        text = f"{value:.0f}"
    return text.replace("-", MINUS)


def fixed_text(value: float, decimals: int) -> str:
    """Return a number with so many decimals, a dash where there is none."""
    if math.isnan(value):
        return DASH
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", MINUS)


def signed_text(value: float) -> str:
    """Return a number with its sign: +0.5, −3, 0."""
    text = number_text(value)
    return f"+{text}" if value > 0 else text


def interval_text(low: float, high: float, digits: int = 4) -> str:
    """Return an interval as a text: 0.24 to 1.82."""
    return f"{number_text(low, digits)} to {number_text(high, digits)}"


def print_text(text: str) -> str:
    """Return a text of the terminal with the signs of print; no line ends behind a minus."""
    text = text.replace("+-", "±")
    return re.sub(r"(?<![\w.])-(?=[\d.])|(?<=\de)-(?=\d)", MINUS, text)


def unbroken_text(text: str) -> str:
    """Keep a number, its sign and its error, and the two ends of an interval, in one line."""
    return re.sub(" (±|to) ", rf"{NO_BREAK}\1{NO_BREAK}", print_text(text))
