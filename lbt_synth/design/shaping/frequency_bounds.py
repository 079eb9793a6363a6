"""Bounds at single frequencies, tightened for what lies between them, and bands of frequencies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.design.certificate import Check
from lbt_synth.linear import StateSpace
from lbt_synth.linear.convex_functions import Discs
from lbt_synth.linear.norms import band_norm
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    NotNegative,
    check_fields,
    number,
    set_fields,
)

ROOM = 1e-3  # part of a bound that the programme leaves for what lies between its points
LEVEL_SETS = "level sets, all frequencies"


class CheckedFields:
    """Base of dataclasses of which the types of fields hold the bounds of numbers."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Band(CheckedFields):
    """Band from ``low_hz`` to ``high_hz``, both included, from which terms and demands derive.

    Raises
    ------
    ProblemError
        If the ends are no numbers of at least 0 in increasing order.
    """

    low_hz: NotNegative
    high_hz: float

    def __post_init__(self) -> None:
        CheckedFields.__post_init__(self)
        set_fields(self, high_hz=number(self.high_hz, "high_hz", above=self.low_hz))

    @property
    def band_text(self) -> str:
        """The band in words."""
        return f"{self.low_hz:g}-{self.high_hz:g} Hz"

    def peak(self, system: StateSpace) -> float:
        """Return an upper bound of a system's largest gain in the band, by level sets."""
        return band_norm(system, self.low_hz, self.high_hz).upper

    def check(self, name: str, peak: float, limit: float) -> Check:
        """Return the check of a peak in the band."""
        return Check(name, peak, limit, "level sets, all of the band")


def discs(frequency_hz: FloatArray, rows: ComplexArray, centre: float, radius: float) -> Discs:
    """Return discs ``|centre + rows c| <= radius`` at frequencies."""
    return Discs(
        frequency_hz=frequency_hz,
        rows=rows,
        centres=np.full(frequency_hz.size, centre, dtype=np.complex128),
        radii=np.full(frequency_hz.size, radius),
    )
