"""Tables I, II and III of Agapito et al. (2008) as printed there.

G. Agapito, F. Quiros-Pacheco, P. Tesi, A. Riccardi, S. Esposito, "Optimal filtering techniques
for the adaptive optics system of the LBT" (2008).
"""

from __future__ import annotations

import math
from typing import NamedTuple

VIBRATION_HZ = 20.0


class PublishedRow(NamedTuple):
    """Strehl ratios [%] at 2.2 um for a model frequency [Hz]."""

    model_hz: float
    kalman: float
    hinf: float
    classical: float = math.nan
    vibration: bool = True
    table: str = "III"

    @property
    def error_hz(self) -> float | None:
        """Frequency of the model less that of the vibration [Hz]; None without one."""
        return self.model_hz - VIBRATION_HZ if self.vibration else None

    @property
    def label(self) -> str:
        """Name of the row."""
        if self.table == "III":
            return f"{self.model_hz:.1f} Hz"
        return "vibration" if self.vibration else "no vibration"


TABLE_II = (
    PublishedRow(20.0, 80.7, 80.4, classical=84.1, vibration=False, table="II"),
    PublishedRow(20.0, 80.4, 80.2, classical=30.9, table="II"),
)

TABLE_III = (
    PublishedRow(16.5, 22.4, 30.9),
    PublishedRow(17.0, 25.5, 36.4),
    PublishedRow(17.5, 30.6, 43.7),
    PublishedRow(18.0, 39.1, 52.7),
    PublishedRow(18.5, 51.0, 62.8),
    PublishedRow(19.0, 65.0, 71.3),
    PublishedRow(19.5, 76.8, 78.4),
    PublishedRow(20.0, 80.4, 80.2),
    PublishedRow(20.5, 77.8, 78.4),
    PublishedRow(21.0, 70.1, 74.1),
    PublishedRow(21.5, 61.0, 67.6),
    PublishedRow(22.0, 52.8, 60.7),
    PublishedRow(22.5, 46.1, 54.5),
    PublishedRow(23.0, 40.9, 48.9),
    PublishedRow(23.5, 36.9, 44.6),
)
