"""Peaks over a band and of the real part, against a dense grid."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import lbt_synth as lbt
from lbt_synth.linear.norms import band_norm, largest_real_part


# -- peaks over frequency --------------------------------------------------------------------
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_peaks_of_a_band_and_of_the_real_part_against_a_dense_grid(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 0.99) / np.max(np.abs(np.linalg.eigvals(A)))
    system = lbt.linear.StateSpace(
        A=A, B=rng.normal(size=(n, 1)), C=rng.normal(size=(1, n)), D=rng.normal(size=(1, 1))
    )
    low, high = np.sort(rng.uniform(0, 0.5, 2))
    f = np.linspace(0, 0.5, 20001)
    response = system.frequency_response(f)[:, 0, 0]
    largest = largest_real_part(system)
    size = np.max(np.abs(response))
    assert largest >= np.max(response.real) - 1e-9 * size
    assert largest <= np.max(response.real) + 1e-3 * size
    inside = np.linspace(low, high, 4001)
    dense = np.max(np.abs(system.frequency_response(inside)))
    found = band_norm(system, low, high)
    assert dense * (1 - 1e-10) <= found.upper <= dense * 1.001
    assert low <= found.peak_frequency_hz <= high
