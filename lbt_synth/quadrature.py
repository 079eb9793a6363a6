"""Composite Gauss-Legendre quadrature."""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import FloatArray


def gauss_panels(edges: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights of a Gauss-Legendre rule on each of consecutive panels.

    Parameters
    ----------
    edges : (panels + 1,) ndarray
        Increasing ends of the panels.
    order : int
        Nodes a panel.

    Returns
    -------
    nodes, weights : (panels * order,) ndarray
        Flattened, in increasing order.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.quadrature import gauss_panels
    >>> x, w = gauss_panels(np.array([0.0, 1.0, 3.0]), 4)
    >>> round(float(w @ x**7), 9)                     # 3^8 / 8
    820.125
    """
    x, w = np.polynomial.legendre.leggauss(order)
    half = np.diff(edges)[:, None] / 2
    middle = (edges[:-1] + edges[1:])[:, None] / 2
    return (middle + half * x).ravel(), (half * w).ravel()
