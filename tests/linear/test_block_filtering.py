"""Series of many systems, against their recursion."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.systems import random_system

from lbt_synth.linear import StateSpace
from lbt_synth.linear.block_filtering import filter_series, series_states


@given(
    seed=st.integers(0, 1000),
    n=st.integers(1, 5),
    frames=st.integers(1, 700),
    cases=st.integers(1, 3),
)
def test_block_products_are_the_recursion(seed, n, frames, cases):
    A, B, C, D = random_system(seed, n, 2, 3, 0.999)
    u = np.random.default_rng(seed).standard_normal((cases, frames, 2))
    x, expected = np.zeros((cases, n)), np.empty((cases, frames, 3))
    for k in range(frames):
        expected[:, k] = x @ C.T + u[:, k] @ D.T
        x = x @ A.T + u[:, k] @ B.T
    for case in range(cases):
        states = series_states(A, u[case] @ B.T)
        limit = 1e-9 * (1 + np.abs(states).max())
        assert np.allclose(states[-1], x[case], rtol=1e-9, atol=limit)
    out = filter_series(StateSpace(A=A, B=B, C=C, D=D), u)
    assert np.allclose(out, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
