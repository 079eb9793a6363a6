"""Controllers of transfer functions whose poles lie close together."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbt_synth.errors import NumericalError
from lbt_synth.interop.iir.realisation import build_controller


def quotient(num, den, z):
    """The response at a point with exact coefficients and an exact point, (complex,)."""
    re, im = Fraction(float(z.real)), Fraction(float(z.imag))
    values = []
    for part in (num, den):
        a, b = Fraction(0), Fraction(0)
        for value in part[::-1]:  # Horner's rule in exact numbers
            a, b = a * re - b * im + Fraction(float(value)), a * im + b * re
        values.append((a, b))
    (p, q), (r, s) = values
    size = r * r + s * s
    return complex(float((p * r + q * s) / size), float((q * r - p * s) / size))


@given(
    angles=st.lists(st.floats(0, np.pi), min_size=0, max_size=4),
    real=st.lists(st.floats(-0.99, 0.999), min_size=0, max_size=3),
    zeros=st.integers(0, 3),
    seed=st.integers(0, 99),
)
def test_the_response_is_that_of_the_coefficients(angles, real, zeros, seed):
    roots = [0.99 * np.exp(1j * a) for a in angles]
    roots = [*roots, *np.conj(roots), *real, *[0.0] * zeros]
    den = np.atleast_1d(np.real(np.poly(roots)))[::-1] if roots else np.ones(1)
    num = np.random.default_rng(seed).standard_normal(den.size)
    system = build_controller(num[None], den[None], 1.0).to_statespace()
    for f in (0.0, 0.013, 0.31, 0.5):
        z = np.exp(2j * np.pi * f)
        found = system.C @ np.linalg.solve(z * np.eye(system.n_states) - system.A, system.B)
        exact = quotient(num, den, z)
        assert abs(found[0, 0] + system.D[0, 0] - exact) <= 1e-7 * (abs(exact) + 1)


def test_close_poles_are_kept_apart():
    """Eight poles within 1e-3 of each other, next to where the response is asked."""
    den = np.poly(0.98 + 1e-4 * np.arange(8))[::-1]
    num = np.ones(9)
    system = build_controller(num[None], den[None], 1.0).to_statespace()
    for f in (0.0, 1e-4, 1e-3):
        z = np.exp(2j * np.pi * f)
        found = system.C @ np.linalg.solve(z * np.eye(9) - system.A, system.B) + system.D
        exact = quotient(num, den, z)
        assert abs(found[0, 0] - exact) < 1e-10 * abs(exact)
        assert abs(np.polyval(num[::-1], z) / np.polyval(den[::-1], z) - exact) > 1e-6 * abs(exact)


@pytest.mark.parametrize("order", [0, 1, 2, 5])
def test_numerators_change_the_entry_alone(order):
    den = np.append(0.1 * np.ones(order), 2.0)[None]
    one, other = (build_controller(g * np.ones((1, order + 1)), den, 1.0) for g in (1.0, 3.0))
    assert np.array_equal(one.A, other.A)
    assert np.array_equal(one.C, other.C)
    assert np.allclose(3 * one.B, other.B, rtol=1e-14)
    assert one.B[-1, 0] == 0.5


@pytest.mark.parametrize("beyond", [np.inf, np.nan, 1e300])
def test_coefficients_beyond_the_range_are_refused(beyond):
    """Single precision makes them infinite; the quotient of others is too large."""
    with pytest.raises(NumericalError, match="beyond the range"):
        build_controller(np.array([[beyond, 1.0]]), np.array([[0.5, 1e-30]]), 1.0)
