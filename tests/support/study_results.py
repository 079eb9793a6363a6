"""Samples and results of studies that were never run."""

import numpy as np
from scipy.stats import qmc


def draw_points(kind, n, dimensions, seed):
    if kind == "independent":
        return np.random.default_rng(seed).random((n, dimensions))
    engine = qmc.Sobol if kind == "sobol" else qmc.LatinHypercube
    return engine(dimensions, seed=seed).random(n)


def make_columns(parameters, strehls, **changes):
    """Columns of results in which every loop is stable, unless changed."""
    columns = dict(parameters)
    for name, strehl in strehls.items():
        n = len(strehl)
        columns |= {
            f"{name}.strehl": strehl,
            f"{name}.stable": np.ones(n),
            f"{name}.residual_nm": np.full(n, 100.0),
        }
    return columns | changes


def cell_text(cell):
    return cell if isinstance(cell, str) else cell.text
