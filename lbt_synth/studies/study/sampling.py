"""Points of the unit cube: Sobol's, scrambled, or a Latin hypercube (``scipy.stats.qmc``).

The same seed gives the same points, whoever asks for which of them.
"""

from __future__ import annotations

import inspect
from functools import lru_cache
from typing import Any

import numpy as np

from lbt_synth.validation import FloatArray


def unit_points(
    sampling: str, *, samples: int, dimensions: int, seed: int, start: int, stop: int
) -> FloatArray:
    """Return points ``start`` to ``stop`` of so many, (stop - start, dimensions) in [0, 1).

    Sobol's sequence does not depend on ``samples``: more of them begin with the same. Each of
    its blocks of 2^k points is balanced, so that a power of two is the best number of samples;
    any other is allowed. A Latin hypercube is made as a whole, once a process.

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

    engine = qmc.Sobol(dimensions, scramble=True, **_generator(seed))
    if start > 0:
        engine.fast_forward(start)
        return np.asarray(engine.random(stop - start))
    first = engine.random(1)  # asked for at once, any number but a power of two is warned of
    return np.vstack([first, engine.random(stop - 1)]) if stop > 1 else np.asarray(first)


@lru_cache(maxsize=1)
def _hypercube(samples: int, dimensions: int, seed: int) -> FloatArray:
    from scipy.stats import qmc

    points = np.asarray(qmc.LatinHypercube(dimensions, **_generator(seed)).random(samples))
    points.setflags(write=False)
    return points


def _generator(seed: int) -> dict[str, Any]:
    """Return a generator under the name that the installed SciPy knows it by."""
    from scipy.stats import qmc

    name = "rng" if "rng" in inspect.signature(qmc.Sobol.__init__).parameters else "seed"
    return {name: np.random.default_rng(seed)}
