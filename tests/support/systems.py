"""Random linear systems."""

import numpy as np


def random_system(seed, n, m, p, radius):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= radius / max(abs(np.linalg.eigvals(A)))
    return A, rng.standard_normal((n, m)), rng.standard_normal((p, n)), rng.standard_normal((p, m))
