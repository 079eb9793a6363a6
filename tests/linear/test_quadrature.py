"""Integrals that the panels cannot settle."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear.quadrature import adaptive_integral, refine_panels


def test_integrals_that_do_not_settle():
    with pytest.raises(lbt.errors.NumericalError, match="did not settle"):
        refine_panels(lambda x: (1 / x)[:, None], np.array([0.0, 1.0]))


def test_integrals_of_stacks():
    """Each member gets its own accuracy, though the panels are shared."""

    def peaks(x):
        widths = np.array([1e-4, 1e-2])
        return (1e-3 * widths / (widths**2 + (x[:, None] - 0.3) ** 2))[..., None, None]

    found = adaptive_integral(peaks, np.array([0.0, 1.0]))
    widths = np.array([1e-4, 1e-2])
    expected = 1e-3 * (np.arctan(0.7 / widths) + np.arctan(0.3 / widths))
    assert found[:, 0, 0] == pytest.approx(expected, rel=1e-7)
