"""Interaction matrices."""

from __future__ import annotations

import numpy as np


def interaction(q: int, n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((q, n))
