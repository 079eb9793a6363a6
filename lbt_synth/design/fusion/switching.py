"""How often sensors may fail and return: stable filters that take turns need not be stable.

Where the plant is its model, the estimation error does not depend on the commands. It shrinks in a
fixed norm while a filter stays long enough, whichever filter came before.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.design.fusion.failures import Fallback
from lbt_synth.linear.periodic.system import PeriodicSystem
from lbt_synth.models.fusion.plant import FusedPlant
from lbt_synth.validation import FloatArray

LONGEST_DWELL = 10_000  # periods
_REGULAR = 1e-2  # of the covariance's diagonal, added: some states are functions of others


def dwell_frames(
    plant: FusedPlant, gains: FloatArray, fallbacks: tuple[Fallback, ...]
) -> int | None:
    """Return frames that each filter must stay for any sequence of them to be stable.

    The norm weighs the error by the covariance of the plant's state, mean over the phases. If a
    filter shrinks it in any number of periods from m to 2 m - 1, it does in any more.
    """
    P = plant.error_system(np.zeros_like(gains)).covariances().mean(axis=0)
    root = np.linalg.cholesky(P + _REGULAR * np.diag(np.diag(P)))
    filters = [gains, *(each.gains for each in fallbacks)]
    needed = [_periods(plant.error_system(own), root) for own in filters]
    periods = [each for each in needed if each is not None]
    return (max(periods) + 2) * plant.period - 2 if len(periods) == len(filters) else None


def _periods(error: PeriodicSystem, root: FloatArray) -> int | None:
    """Return after how many whole periods an error has shrunk, wherever in a period it begins."""
    inverse, each = np.linalg.inv(root), np.eye(len(root))

    def size(transition: FloatArray) -> float:
        return float(np.linalg.norm(inverse @ transition @ root, 2))

    before = after = 1.0  # of the parts of a period at both ends
    head = tail = each
    for A, last in zip(error.A[:-1], error.A[:0:-1], strict=True):
        head, tail = A @ head, tail @ last
        after, before = max(after, size(head)), max(before, size(tail))
    allowed, period = 1 / (before * after), error.monodromy
    transition, shrunk = each, 0
    for count in range(1, LONGEST_DWELL):
        transition = period @ transition
        shrunk = shrunk if size(transition) < allowed else count
        if count >= 2 * shrunk + 1:
            return shrunk + 1
    return None
