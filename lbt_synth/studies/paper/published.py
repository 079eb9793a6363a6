"""Tables I, II and III of Agapito et al. (2008) as printed there.

G. Agapito, F. Quiros-Pacheco, P. Tesi, A. Riccardi, S. Esposito, "Optimal filtering techniques
for the adaptive optics system of the LBT" (2008).
"""

from __future__ import annotations

from typing import NamedTuple


class TableII(NamedTuple):
    """Strehl ratios [%] at 2.2 um without or with the vibration."""

    vibration: bool
    classical: float
    kalman: float
    hinf: float


class TableIII(NamedTuple):
    """Strehl ratios [%] at 2.2 um for a model frequency [Hz]; the truth is 20 Hz."""

    model_hz: float
    kalman: float
    hinf: float


TABLE_II = (
    TableII(False, 84.1, 80.7, 80.4),
    TableII(True, 30.9, 80.4, 80.2),
)

TABLE_III = (
    TableIII(16.5, 22.4, 30.9),
    TableIII(17.0, 25.5, 36.4),
    TableIII(17.5, 30.6, 43.7),
    TableIII(18.0, 39.1, 52.7),
    TableIII(18.5, 51.0, 62.8),
    TableIII(19.0, 65.0, 71.3),
    TableIII(19.5, 76.8, 78.4),
    TableIII(20.0, 80.4, 80.2),
    TableIII(20.5, 77.8, 78.4),
    TableIII(21.0, 70.1, 74.1),
    TableIII(21.5, 61.0, 67.6),
    TableIII(22.0, 52.8, 60.7),
    TableIII(22.5, 46.1, 54.5),
    TableIII(23.0, 40.9, 48.9),
    TableIII(23.5, 36.9, 44.6),
)
