"""Random linear systems."""

import numpy as np


def random_system(seed, n, m, p, radius, *phases):
    """Return A, B, C and D of a system, or a stack of as many as it has phases."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((*phases, n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    return A, *(rng.standard_normal((*phases, *size)) for size in ((n, m), (p, n), (p, m)))
