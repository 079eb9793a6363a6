"""Series of autoregressive processes."""

import numpy as np
from scipy.signal import lfilter


def ar_series(coefficients, driving, modes, frames, rng):
    """Stationary series of one process, (modes, frames)."""
    white = driving * rng.standard_normal((modes, frames + 30_000))
    return lfilter([1.0], [1.0, *(-np.array(coefficients))], white, axis=1)[:, 30_000:]
