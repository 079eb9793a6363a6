"""Units of recorded tip and tilt, and what makes nanometres of wavefront of them."""

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
_ALIASES = {
    "nanometer": "nm",
    "nanometre": "nm",
    "micron": "um",
    "micrometer": "um",
    "micrometre": "um",
    "µm": "um",
    "μm": "um",
    "meter": "m",
    "metre": "m",
    "µrad": "urad",
    "μrad": "urad",
    "microrad": "urad",
    "radian": "rad",
    "arcsecond": "arcsec",
    "asec": "arcsec",
    '"': "arcsec",
    "milliarcsec": "mas",
    "milliarcsecond": "mas",
}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
FREQUENCIES = {"hz": 1.0, "khz": 1e3, "mhz": None}  # mHz or MHz: capitals tell
_SQUARED = re.compile(r"^(?P<unit>.+?)(?:\^2|\*\*2|²|2)\s*(?:/|_|\s|per)\s*hz$", re.IGNORECASE)
_ROOT = re.compile(
    r"^(?P<unit>.+?)\s*(?:/|_|per)\s*(?:sqrt\(?hz\)?|rthz|√hz|hz\^?(?:0\.5|\(1/2\)))$",
    re.IGNORECASE,
)


def unit_name(text: str) -> str | None:
    """Return the name that this package has for a unit; None if it knows none such."""
    word = text.strip()
    lower = word.lower()
    found = _ALIASES.get(lower) or _ALIASES.get(lower.removesuffix("s")) or lower
    return found if found in UNITS else None


def nm_per(unit: str, *, diameter_m: float | None = None) -> float:
    """Return the nanometres of wavefront, rms over the pupil, of one unit."""
    word = unit_name(unit) if isinstance(unit, str) else None
    if word is None:
        choice(unit, "unit", UNITS)
        raise AssertionError  # choice refuses
    if word in _NM:
        return _NM[word]
    if diameter_m is None:
        raise ProblemError(
            f"angles of tilt ({word}) become nm of wavefront by the telescope's diameter; give "
            "diameter_m."
        )
    return _MAS[word] * nm_per_mas(diameter_m)


def seconds_per(unit: str | None) -> float:
    """Return the seconds of a unit of time; of none, 1."""
    factor = TIMES.get((unit or "s").strip().lower())
    if factor is None:
        raise ProblemError(f"times must be in one of {', '.join(TIMES)}; got {unit!r}.")
    return factor


def hz_per(unit: str | None) -> float:
    """Return the hertz of a unit of frequency; of none, 1."""
    word = (unit or "Hz").strip()
    if word in ("mHz", "MHz"):
        return 1e-3 if word == "mHz" else 1e6
    factor = FREQUENCIES.get(word.lower())
    if factor is None:
        raise ProblemError(f"frequencies must be in one of Hz, kHz, mHz, MHz; got {unit!r}.")
    return factor


def density_unit(text: str) -> tuple[str, int] | None:
    """Part a unit of a spectrum: the unit and the power that the density has of it."""
    for pattern, power in ((_ROOT, 1), (_SQUARED, 2)):
        if match := pattern.match(text.strip()):
            unit = unit_name(match["unit"])
            return None if unit is None else (unit, power)
    return None
