"""Units of tip and tilt, times and spectra, and their factors to nm of wavefront, s and Hz."""

from __future__ import annotations

import math
import re

from lbt_synth.errors import ProblemError
from lbt_synth.models import nm_per_mas
from lbt_synth.validation import choice

_NM = {"nm": 1.0, "um": 1e3, "m": 1e9}
_MAS = {
    "mas": 1.0,
    "arcsec": 1e3,
    "urad": math.degrees(1e-6) * 3600e3,
    "rad": math.degrees(1.0) * 3600e3,
}
UNITS = (*_NM, *_MAS)
_OTHER_NAMES = {
    "nm": "nanometer nanometre",
    "um": "micron micrometer micrometre µm μm",
    "m": "meter metre",
    "urad": "µrad μrad microrad",
    "rad": "radian",
    "arcsec": 'arcsecond asec "',
    "mas": "milliarcsec milliarcsecond",
}
_ALIASES = {other: unit for unit, names in _OTHER_NAMES.items() for other in names.split()}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_HERTZ = {"hz": 1.0, "khz": 1e3, "mHz": 1e-3, "MHz": 1e6}  # capitals matter where both exist
_CLOCK_UNITS = {*_SECONDS, *(word.lower() for word in _HERTZ)}
_SQUARED = re.compile(r"^(?P<unit>.+?)(?:\^2|\*\*2|²|2)\s*(?:/|_|\s|per)\s*hz$", re.IGNORECASE)
_ROOT = re.compile(
    r"^(?P<unit>.+?)\s*(?:/|_|per)\s*(?:sqrt\(?hz\)?|rthz|√hz|hz\^?(?:0\.5|\(1/2\)))$",
    re.IGNORECASE,
)


def unit_name(text: str) -> str | None:
    """Return the name that this package has for a unit, None for an unknown one."""
    lower = text.strip().lower()
    found = _ALIASES.get(lower) or _ALIASES.get(lower.removesuffix("s")) or lower
    return found if found in UNITS else None


def density_unit(text: str) -> tuple[str, int] | None:
    """Split the unit of a spectrum into a unit and its power, 1 or 2; None for others."""
    for pattern, power in ((_ROOT, 1), (_SQUARED, 2)):
        if match := pattern.match(text.strip()):
            unit = unit_name(match["unit"])
            return None if unit is None else (unit, power)
    return None


def is_unit(text: str) -> bool:
    """Whether a text is a unit of a series, a spectrum, times or frequencies."""
    return bool(unit_name(text) or density_unit(text)) or text.lower() in _CLOCK_UNITS


def same_unit(one: str, other: str) -> bool:
    """Whether two texts are the same unit."""
    return len({unit_name(u) or density_unit(u) or u.lower() for u in map(str, (one, other))}) == 1


def nm_per(unit: str, *, diameter_m: float | None = None) -> float:
    """Return the nanometres of wavefront, rms over the pupil, of one unit."""
    word = choice((unit_name(unit) if isinstance(unit, str) else None) or unit, "unit", UNITS)
    if word in _NM:
        return _NM[word]
    if diameter_m is None:
        raise ProblemError(
            f"angles of tilt ({word}) become nm of wavefront by the telescope's diameter; give "
            "diameter_m."
        )
    return _MAS[word] * nm_per_mas(diameter_m)


def seconds_per(unit: str | None) -> float:
    """Return the seconds of a unit of time, 1 if no unit is given."""
    factor = _SECONDS.get((unit or "s").strip().lower())
    if factor is None:
        raise ProblemError(f"times must be in one of {', '.join(_SECONDS)}; got {unit!r}.")
    return factor


def hz_per(unit: str | None) -> float:
    """Return the hertz of a unit of frequency, 1 if no unit is given."""
    word = (unit or "Hz").strip()
    factor = _HERTZ.get(word) or _HERTZ.get(word.lower())
    if factor is None:
        raise ProblemError(f"frequencies must be in one of Hz, kHz, mHz, MHz; got {unit!r}.")
    return factor
