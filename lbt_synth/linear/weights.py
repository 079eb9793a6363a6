"""Weights of the errors and disturbances of a generalised plant."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.validation import FloatArray


class Weight(NamedTuple):
    """Matrices of a weight in textbook form; a constant one has no states."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


def constant_weight(D: FloatArray) -> Weight:
    """Return a weight without states."""
    return Weight(np.zeros((0, 0)), np.zeros((0, D.shape[1])), np.zeros((len(D), 0)), D)


def stack_weights(weights: Iterable[Weight]) -> Weight:
    """Return weights of signals that lie one after the other, as one weight of all of them."""
    return Weight(*(block_diag(*parts) for parts in zip(*weights, strict=True)))


def weigh_plant(
    plant: GeneralizedPlant, errors: Weight, disturbances: Weight | None = None
) -> GeneralizedPlant:
    """Return the plant with a weight after its errors, and one before its disturbances.

    The states are those of the plant, of the weight of the disturbances and of that of the errors.
    """
    P, left = plant, errors
    right = constant_weight(np.eye(P.B1.shape[1])) if disturbances is None else disturbances
    n, r, s, none = len(P.A), len(right.A), len(left.A), np.zeros
    A = np.block(
        [
            [P.A, P.B1 @ right.C, none((n, s))],
            [none((r, n)), right.A, none((r, s))],
            [left.B @ P.C1, left.B @ P.D11 @ right.C, left.A],
        ]
    )
    return replace(
        P,
        A=A,
        B1=np.vstack([P.B1 @ right.D, right.B, left.B @ P.D11 @ right.D]),
        B2=np.vstack([P.B2, none((r, P.B2.shape[1])), left.B @ P.D12]),
        C1=np.hstack([left.D @ P.C1, left.D @ P.D11 @ right.C, left.C]),
        C2=np.hstack([P.C2, P.D21 @ right.C, none((len(P.C2), s))]),
        D11=left.D @ P.D11 @ right.D,
        D12=left.D @ P.D12,
        D21=P.D21 @ right.D,
    )
