"""Responses of many systems at once, by partial fractions, also of systems that have none."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear.state_space import pointwise_response, stacked_response


def test_partial_fractions_and_what_has_none():
    rng = np.random.default_rng(8)
    A = rng.standard_normal((3, 4, 4)) / 3
    A[1] = np.eye(4, k=-1)  # a chain of delays: defective
    B, C, D = rng.standard_normal((3, 4, 2)), rng.standard_normal((3, 1, 4)), np.ones((3, 1, 2))
    z = np.exp(1j * np.linspace(0.01, 3, 50))
    found = stacked_response((A, B, C, D), z)
    for k in range(3):
        system = lbt.linear.StateSpace(A=A[k], B=B[k], C=C[k], D=D[k])
        assert found[:, k] == pytest.approx(pointwise_response(system, z), rel=1e-9, abs=1e-9)
