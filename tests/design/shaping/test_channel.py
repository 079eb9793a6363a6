"""Orthonormal functions with given poles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.shaping import (
    RATE,
)

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import laguerre_basis, orthonormal_basis


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(-0.95, 0.99), max_size=4),
    st.lists(st.tuples(st.floats(0.05, 0.999), st.floats(0.01, 3.1)), min_size=1, max_size=5),
)
def test_a_basis_is_orthonormal_and_has_its_poles(real, pairs):
    upper = np.array([r * np.exp(1j * a) for r, a in pairs])
    poles = np.concatenate([upper, upper.conj(), np.array(real, dtype=complex)])
    basis = orthonormal_basis(poles, dt_s=1.0)
    np.testing.assert_allclose(
        basis.A @ basis.A.T + basis.B @ basis.B.T, np.eye(len(poles)), atol=1e-9
    )
    # the characteristic polynomial: the poles themselves are ill-conditioned where they repeat
    np.testing.assert_allclose(np.poly(basis.A), np.poly(poles).real, atol=1e-8)


def test_taps_and_laguerre_functions_are_special_cases():
    f = np.array([0.0, 3.0, 77.0, 400.0])
    z = np.exp(2j * np.pi * f / RATE)[:, None]
    taps = laguerre_basis(5, 0.0, dt_s=1 / RATE).response(f)
    np.testing.assert_allclose(np.abs(taps), 1, atol=1e-12)
    np.testing.assert_allclose(taps**2, (z ** -np.arange(5)) ** 2, atol=1e-12)  # but for signs
    a, k = 0.6, np.arange(5)
    expected = np.sqrt(1 - a * a) * z / (z - a) * ((1 - a * z) / (z - a)) ** k
    found = laguerre_basis(5, a, dt_s=1 / RATE).response(f)
    np.testing.assert_allclose(np.abs(found), np.abs(expected), atol=1e-12)


@pytest.mark.parametrize(
    ("poles", "message"), [([1.0], "inside the unit circle"), ([0.5 + 0.1j], "conjugate pairs")]
)
def test_a_basis_refuses_poles_that_are_none(poles, message):
    with pytest.raises(lbt.errors.ProblemError, match=message):
        orthonormal_basis(np.array(poles, dtype=complex), dt_s=1.0)
