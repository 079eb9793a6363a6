"""Why no controller stabilises a plant: the mode that is out of reach, or out of sight."""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import DetectabilityError
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.riccati.solvability import unstable_hidden_mode
from lbt_synth.validation import FloatArray, frozen_copy

_LISTED = 4  # states that a message names
_SHARE = 1e-6  # of the largest entry, below which a state has no part in a mode


def require_stabilisable(plant: GeneralizedPlant, rate: float | None = None) -> None:
    """Raise if a mode that does not decay is not reached by u, or not seen by y.

    The plant is in discrete time; if it is the map of one in continuous time with some rate
    [1/s], the message gives the mode of that one.
    """
    reached = unstable_hidden_mode(plant.A.T, plant.B2.T, drive=plant.C1.T)
    seen = unstable_hidden_mode(plant.A, plant.C2, drive=plant.B1)
    for value, A, C, words in (
        (reached, plant.A.T, plant.B2.T, "no control reaches it. Give it a control"),
        (seen, plant.A, plant.C2, "no measurement sees it. Measure it"),
    ):
        if value is None:
            continue
        vector = _null_vector(A, C, value)
        shown = value if rate is None else rate * (value - 1) / (value + 1)
        raise DetectabilityError(
            f"no controller stabilises the plant: its mode at {_number(shown)} does not decay, and "
            f"{words}, or take it out of the plant (a weight with such a pole: let it decay a "
            f"little). The mode is made of the states {_states(vector)}.",
            eigenvalue=shown,
            eigenvector=frozen_copy(np.abs(vector)),
        )


def _null_vector(A: FloatArray, C: FloatArray, value: complex) -> FloatArray:
    """Return the unit vector that C does not see and A multiplies by a value, (n,) complex."""
    pencil = np.vstack([A - value * np.eye(len(A)), C])
    return np.asarray(np.linalg.svd(pencil)[2][-1].conj())


def _states(vector: FloatArray) -> str:
    """Name the states that have a part in a mode, the largest first."""
    size = np.abs(vector)
    order = [int(i) for i in np.argsort(-size) if size[i] > _SHARE * size.max()]
    named = ", ".join(f"{i} ({size[i] / size.max():.3g})" for i in order[:_LISTED])
    return named + (", ..." if len(order) > _LISTED else "")


def _number(value: complex) -> str:
    return f"{value.real + 0.0:.6g}" if abs(value.imag) <= 1e-9 * abs(value) else f"{value:.6g}"
