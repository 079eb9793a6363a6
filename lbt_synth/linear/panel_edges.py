"""Panels of an adaptive integral over frequency, which crowd at resonances."""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy


def panel_edges(poles: ComplexArray, frame_rate_hz: float) -> FloatArray:
    """Panels of (0, Nyquist) [Hz]: geometric, and more of them around each pole."""
    edges = [np.geomspace(1e-6, 1, 40), np.array([0.0]), pole_edges(poles)]
    return frozen_copy(distinct_edges(np.concatenate(edges)) * (frame_rate_hz / 2))


def pole_edges(poles: ComplexArray) -> FloatArray:
    """Edges of panels around sharp poles, in units of the Nyquist frequency, unsorted.

    The panels widen with the distance from the pole until other panels are as fine. A flank of a
    narrow peak must not lie in one long panel: the nodes of its halves would miss it, too.
    """
    edges = [np.zeros(0)]
    for pole in np.ravel(poles):
        centre, width = abs(np.angle(pole)) / np.pi, max(1 - abs(pole), 1e-9) / np.pi
        if width < 0.1:
            steps = max(3, 1 + int(np.log(0.3 / width) / np.log(4)))
            offsets = np.concatenate([[0.0], width * 4.0 ** np.arange(steps)])
            edges += [centre + offsets, centre - offsets]
    return np.concatenate(edges)


def distinct_edges(edges: FloatArray) -> FloatArray:
    """Sort edges into (0, 1), and drop those that coincide."""
    grid = np.unique(np.clip(edges, 0, 1))
    return np.asarray(grid[np.concatenate([[True], np.diff(grid) > 1e-12])])
