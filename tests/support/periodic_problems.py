"""Random problems whose measurements are not all read in every sample."""

import numpy as np

from lbt_synth.linear import EstimationProblem, StateSpace


def random_periodic_problem(seed):
    """Up to 8 states, 3 measurements and 12 phases, some without a reading; noise is correlated."""
    rng = np.random.default_rng(seed)
    n, q, N = int(rng.integers(1, 9)), int(rng.integers(1, 4)), int(rng.integers(2, 13))
    phases = N if seed % 2 else 1
    A = rng.standard_normal((phases, n, n))
    A *= rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    read = rng.random((N, q)) < 0.4
    read[0] = True
    units = 10.0 ** rng.uniform(-5, 2, (q, 1))
    B, C = rng.standard_normal((1, n, n + q)), units * rng.standard_normal((1, q, n))
    D = np.hstack([0.3 * rng.standard_normal((q, n)), np.diag(rng.uniform(0.3, 3, q))])
    L = rng.standard_normal((2, n))
    return EstimationProblem(A=A, B=B, C=C, D=(units * D)[None], L=L, read=read)


def relative_distance(own, expected):
    return np.linalg.norm(np.asarray(own) - expected) / np.linalg.norm(expected)


def lifted_problem(problem):
    """Return the problem over a period, its measurements in units of the noise of a reading.

    Its predictor's covariance is that of the periodic problem's filter at phase 0.
    """
    parts = {name: getattr(problem, name) for name in "ABCD"}
    system, rows = StateSpace(**parts, dt_s=problem.dt_s).lifted(), problem.read.reshape(-1)
    size = np.linalg.norm(problem.D, axis=2).reshape(-1, 1)[rows]
    C, D = system.C[rows] / size, system.D[rows] / size
    return EstimationProblem(A=system.A, B=system.B, C=C, D=D, L=problem.L, dt_s=system.dt_s)
