"""Plants next to a singular one: every control costs a little, every measurement has some noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.linear.generalized_plant import GeneralizedPlant


def regularise(plant: GeneralizedPlant, share: float) -> GeneralizedPlant:
    """Return the plant with small errors of each control and state, and small disturbances of both.

    ``share`` is their part of the plant's own errors and disturbances. A controller leaves no
    less in the regularised plant than in the plant itself, and in the limit as much.
    """
    P, n = plant, len(plant.A)
    m1, m2, p1, p2 = P.sizes
    error = share * _size(P.C1, P.D12, P.D11)
    push = share * _size(P.B1, P.D21, P.D11)
    C1 = np.vstack([P.C1, np.zeros((m2, n)), error * np.eye(n)])
    D12 = np.vstack([P.D12, error * np.eye(m2), np.zeros((n, m2))])
    B1 = np.hstack([P.B1, np.zeros((n, p2)), push * np.eye(n)])
    D21 = np.hstack([P.D21, push * np.eye(p2), np.zeros((p2, n))])
    D11 = np.zeros((len(C1), B1.shape[1]))
    D11[:p1, :m1] = P.D11
    return replace(P, B1=B1, C1=C1, D11=D11, D12=D12, D21=D21)


def _size(*parts: np.ndarray) -> float:
    return max(float(np.linalg.norm(part, 2)) for part in parts) or 1.0
