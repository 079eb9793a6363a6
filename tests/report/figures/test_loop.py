"""The frequencies of curves of loops."""

import numpy as np
import pytest

from lbt_synth.report.figures.loop import frequency_grid


@pytest.mark.parametrize("near", [28, 60])
def test_a_grid_is_fine_around_lines_and_below_nyquist(near):
    grid = frequency_grid(800, (20.0, 390.0), points=240, near=near)
    assert np.all(np.diff(grid) > 0)
    assert (grid[0], grid[-1]) == (pytest.approx(400 / 10**3.6), 400)
    assert 20.0 in grid
    for centre in (20.0, 390.0, 400.0):
        distances = np.sort(np.abs(grid / centre - 1))
        assert distances[0] == 0
        assert distances[1] == pytest.approx(1e-4, rel=1e-6)
        assert np.max(np.diff(distances[distances < 0.1])) < 0.035
