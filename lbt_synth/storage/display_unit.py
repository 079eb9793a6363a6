"""The unit in which people see a wavefront: nm rms, or an angle on the sky.

Files, JSON and every number in the code stay in nm. A command chooses the unit once it knows the
telescope's diameter; what is printed or drawn after that asks here, as it would ask a locale.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

LENGTHS = {"nm": 1.0, "um": 1000.0}  # of wavefront, in nm
UNITS = (*LENGTHS, "mas", "urad")
_NM = re.compile(r"\Anm(?=\Z|[ ²^/])")
M_S2 = {"m/s2": 1.0, "mm/s2": 1e-3, "um/s2": 1e-6, "g": 9.80665, "mg": 9.80665e-3}  # accelerations


@dataclass(frozen=True, slots=True, kw_only=True)
class DisplayUnit:
    """A unit of wavefront or angle."""

    name: str = "nm"
    nm: float = 1.0  # of wavefront, rms over the pupil, in one unit


_SHOWN: ContextVar[DisplayUnit] = ContextVar("shown", default=DisplayUnit())  # noqa: B039


@contextmanager
def own_display_unit() -> Iterator[None]:
    """Let what is inside choose a unit, and forget it afterwards."""
    token = _SHOWN.set(DisplayUnit())
    try:
        yield
    finally:
        _SHOWN.reset(token)


def show_in(unit: DisplayUnit) -> None:
    """Choose the unit of what is printed and drawn from now on."""
    _SHOWN.set(unit)


def shown_unit(unit: str) -> tuple[str, float]:
    """Return what is shown for a unit such as "nm rms" or "nm²/Hz", and the factor to it."""
    shown = _SHOWN.get()
    if shown.nm == 1 or not _NM.match(unit):
        return unit, 1.0
    power = 2 if unit[2:3] in ("²", "^") else 1
    return _NM.sub(shown.name, unit), shown.nm**-power


def shown_format(spec: str, factor: float) -> str:
    """Return a format with as many digits after a factor as before it."""
    found = re.fullmatch(r"\.(\d+)f", spec)
    if factor == 1 or found is None:
        return spec
    return f".{max(int(found.group(1)) - round(math.log10(factor)), 0)}f"


def nm_text(
    value_nm: float, spec: str = ".3g", *, error_nm: float | None = None, unit: str = "nm"
) -> str:
    """Return a value in nm with its unit, and its error, as they are shown."""
    name, factor = shown_unit(unit)
    error = "" if error_nm is None else f" +- {error_nm * factor:.2g}"
    return f"{value_nm * factor:{shown_format(spec, factor)}}{error} {name}"
