"""Points in the unit cube: a scrambled Sobol sequence or a Latin hypercube.

A seed fixes every point, whichever are requested with it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from lbt_synth.validation import FloatArray


def unit_points(
    sampling: str, *, samples: int, dimensions: int, seed: int, start: int, stop: int
) -> FloatArray:
    """Return points ``start`` to ``stop`` of ``samples``, (stop - start, dimensions) in [0, 1).

    Sobol's sequence does not depend on ``samples``: a longer one begins with the same points.
    Each of its blocks of 2^k points is balanced, so a power of two is the best number of samples;
    any other is allowed. A Latin hypercube is made as a whole, once per process.

    Examples
    --------
    >>> from lbt_synth.studies.study.sampling import unit_points
    >>> points = unit_points("sobol", samples=8, dimensions=2, seed=1, start=0, stop=8)
    >>> (points < 0.5).sum(axis=0).tolist()
    [4, 4]
    """
    if dimensions == 0 or stop == start:
        return np.zeros((stop - start, dimensions))
    if sampling == "latin_hypercube":
        return _hypercube(samples, dimensions, seed)[start:stop]
    from scipy.stats import qmc

    engine = qmc.Sobol(dimensions, scramble=True, seed=np.random.default_rng(seed))
    if start > 0:
        engine.fast_forward(start)
        return np.asarray(engine.random(stop - start))
    first = engine.random(1)  # taken apart, as SciPy warns of a number that is no power of two
    return np.vstack([first, engine.random(stop - 1)]) if stop > 1 else np.asarray(first)


@lru_cache(maxsize=1)
def _hypercube(samples: int, dimensions: int, seed: int) -> FloatArray:
    from scipy.stats import qmc

    engine = qmc.LatinHypercube(dimensions, seed=np.random.default_rng(seed))
    points = np.asarray(engine.random(samples))
    points.setflags(write=False)
    return points
