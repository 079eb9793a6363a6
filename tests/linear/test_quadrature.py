"""Integrals that the panels cannot settle."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear.quadrature import refine_panels


def test_integrals_that_do_not_settle():
    with pytest.raises(lbt.errors.NumericalError, match="did not settle"):
        refine_panels(lambda x: (1 / x)[:, None], np.array([0.0, 1.0]))
