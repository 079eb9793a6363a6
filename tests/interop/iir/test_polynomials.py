"""Exact coefficients of transfer functions."""

from __future__ import annotations

from math import comb

import numpy as np

import lbt_synth as lbt
from lbt_synth.interop.iir.polynomials import axis_polynomials


def test_exact_coefficients_of_close_poles():
    """(z - r)^8 with r = 1 - 2^-10: binomials, where floating-point routes lose half the digits."""
    r, n = 1 - 2.0**-10, 8
    A = r * np.eye(n) + np.eye(n, k=1)
    C, B = np.eye(n)[:1], np.eye(n)[:, -1:]
    ((num, den),) = axis_polynomials(lbt.Controller(A=A, B=B, C=C, D=[[0.0]]))
    exact = [
        comb(n, k) * (-1) ** (n - k) * (1023 ** (n - k)) / 1024 ** (n - k) for k in range(n + 1)
    ]
    assert den.tolist() == exact
    assert num.tolist() == [0, 1] + [0] * (n - 1)
