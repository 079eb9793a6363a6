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

from lbt_synth.errors import ProblemError

LENGTHS = {"nm": 1.0, "um": 1000.0}  # of wavefront, in nm
UNITS = (*LENGTHS, "mas", "urad")
_NM = re.compile(r"\Anm(?=\Z|[ ²^/])")
M_S2 = {"m/s2": 1.0, "mm/s2": 1e-3, "um/s2": 1e-6, "g": 9.80665, "mg": 9.80665e-3}  # accelerations


# name of the unit, and nm of wavefront, rms over the pupil, in one unit
_SHOWN: ContextVar[tuple[str, float]] = ContextVar("shown", default=("nm", 1.0))


@contextmanager
def own_display_unit() -> Iterator[None]:
    """Let what is inside choose a unit, and forget it afterwards."""
    token = _SHOWN.set(("nm", 1.0))
    try:
        yield
    finally:
        _SHOWN.reset(token)


def show_in(name: str, nm: float) -> None:
    """Choose the unit of what is printed and drawn from now on, of so many nm of wavefront."""
    _SHOWN.set((name, nm))


def require_unit(unit: str | None) -> None:
    """Refuse the name of a unit in which no wavefront is shown."""
    if unit not in (None, *UNITS):
        raise ProblemError(f"shown_unit must be one of {', '.join(UNITS)}; got {unit!r}.")


def shown_unit(unit: str) -> tuple[str, float]:
    """Return what is shown for a unit such as "nm rms" or "nm²/Hz", and the factor to it."""
    name, nm = _SHOWN.get()
    if nm == 1 or not _NM.match(unit):
        return unit, 1.0
    power = 2 if unit[2:3] in ("²", "^") else 1
    return _NM.sub(name, unit), nm**-power


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
