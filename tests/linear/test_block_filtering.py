"""Series of many systems, against their recursion."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import lbt_synth as lbt
from lbt_synth.linear.block_filtering import filter_series, series_states


@given(
    seed=st.integers(0, 1000),
    n=st.integers(1, 5),
    frames=st.integers(1, 700),
    cases=st.integers(1, 3),
)
def test_block_products_are_the_recursion(seed, n, frames, cases):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= 0.999 / max(abs(np.linalg.eigvals(A)))
    system = lbt.linear.StateSpace(
        A=A,
        B=rng.standard_normal((n, 2)),
        C=rng.standard_normal((3, n)),
        D=rng.standard_normal((3, 2)),
    )
    u = rng.standard_normal((cases, frames, 2))
    expected = np.empty((cases, frames, 3))
    for case in range(cases):
        x = np.zeros(n)
        for k in range(frames):
            expected[case, k] = system.C @ x + system.D @ u[case, k]
            x = system.A @ x + system.B @ u[case, k]
        states = series_states(A, u[case] @ system.B.T)
        assert np.allclose(states[-1], x, rtol=1e-9, atol=1e-9 * (1 + np.abs(states).max()))
    out = filter_series(system, u)
    assert np.allclose(out, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
