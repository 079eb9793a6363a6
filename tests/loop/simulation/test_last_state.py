"""The last state of a long recursion."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lbt_synth.loop.simulation.block_filtering import last_state


@given(seed=st.integers(0, 100), n=st.integers(1, 5), frames=st.integers(0, 70))
def test_the_last_state_is_that_of_the_recursion(seed, n, frames):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= 0.99 / max(abs(np.linalg.eigvals(A)))
    drive = rng.standard_normal((frames, n))
    x = np.zeros(n)
    for d in drive:
        x = A @ x + d
    assert np.allclose(last_state(A, drive), x, rtol=1e-10, atol=1e-10 * (1 + np.abs(x).max()))
