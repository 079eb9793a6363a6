"""The parts of a system that act on one another, from the links between its variables."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.validation import BoolArray, FloatArray, IntArray


def connected_parts(links: ArrayLike, *, both_ways: bool = False) -> IntArray:
    """Return the number of the part of each of n variables, from links (n, n) that are not zero.

    Variables are of one part if links join them in any direction; ``both_ways``, if each acts on
    the other. ``scipy.sparse.csgraph`` has the same, and is slow to import.

    Examples
    --------
    >>> from lbt_synth.linear.connected_parts import connected_parts
    >>> links = [[1, 0, 0], [1, 1, 0], [0, 0, 1]]
    >>> connected_parts(links).tolist(), connected_parts(links, both_ways=True).tolist()
    ([0, 0, 1], [0, 1, 2])
    """
    forward: BoolArray = np.asarray(links) != 0
    either = forward | forward.T
    part = np.full(len(forward), -1)
    number = 0
    for each in range(len(forward)):
        if part[each] < 0:
            if both_ways:
                own = _reached(forward, each) & _reached(forward.T, each)
            else:
                own = _reached(either, each)
            part[own] = number
            number += 1
    return part


def system_parts(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the numbers of the parts of a system's states, inputs and outputs.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.connected_parts import system_parts
    >>> states, inputs, outputs = system_parts(*(np.eye(2) for _ in range(4)))
    >>> states.tolist(), inputs.tolist(), outputs.tolist()
    ([0, 1], [0, 1], [0, 1])
    """
    (n, m), p = B.shape, len(C)
    links = np.zeros((n + m + p, n + m + p), dtype=np.bool_)
    links[:n, : n + m] = np.hstack([A, B]) != 0
    links[n + m :, : n + m] = np.hstack([C, D]) != 0
    label = connected_parts(links)
    return label[:n], label[n : n + m], label[n + m :]


def _reached(links: BoolArray, start: int) -> BoolArray:
    """Return which variables (n,) links lead to, the start among them."""
    reached = np.zeros(len(links), dtype=np.bool_)
    new = np.arange(len(links)) == start
    while new.any():
        reached |= new
        new = links[new].any(axis=0) & ~reached
    return reached
