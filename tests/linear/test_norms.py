"""Norms over all frequencies and over a band, against SLICOT, closed forms and dense grids."""

from unittest.mock import Mock

import control
import numpy as np
import pytest
import slycot
from hypothesis import given, settings
from hypothesis import strategies as st
from support.refusals import refused, require_refusals
from support.systems import random_system

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, NumericalError, ProblemError, UnstableLoopError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.norms import band_norm, independent_parts, largest_real_part, spectral_norms


@given(
    seed=st.integers(0, 100_000),
    n=st.integers(1, 8),
    m=st.integers(1, 3),
    p=st.integers(1, 3),
    radius=st.sampled_from([0.3, 0.9, 0.999, 1 - 1e-6]),
)
def test_against_slycot(seed, n, m, p, radius):
    A, B, C, D = random_system(seed, n, m, p, radius)
    expected, _ = slycot.ab13dd("D", "I", "N", "D", n, m, p, A, np.eye(n), B, C, D, 1e-12)
    norm = lbt.hinf_norm((A, B, C, D))
    assert float(norm) == pytest.approx(expected, rel=1e-8)
    assert norm.lower <= expected * (1 + 1e-9)
    assert norm.upper >= expected * (1 - 1e-9)
    assert norm.lower <= norm.value <= norm.upper <= norm.lower * (1 + 5e-11)


SHIFT = np.eye(3, k=1), np.eye(3)[:, -1:]
# a peak that units hid
HIDDEN = [[0.7, 0.6], [-0.1, 0.9]], [[1e4], [-1e5]], [[-0.8e-5, 0.4e-5]], [[0]]


@pytest.mark.parametrize(
    ("system", "expected", "rel"),
    [
        *((([[1 - gap]], [[1.0]], [[1.0]], [[0.0]]), 1 / gap, 1e-6) for gap in (1e-3, 1e-6, 1e-9)),
        ((*SHIFT, np.eye(3)[:1], [[0.0]]), 1, 1e-12),  # poles at zero
        ((*SHIFT, np.vstack([np.eye(3)[:1], np.zeros(3)]), [[0.0], [2.0]]), np.sqrt(5), 1e-12),
        (([[0.5]], [[3.0, 4.0]], [[1.0]], [[0.0, 0.0]]), 10, 1e-12),
        (([[0.5]], [[0.0]], [[1.0]], [[0.0]]), 0, 0),
        (([[0.5]], [[0.0]], [[1.0]], [[-3.0]]), 3, 1e-12),
        (control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01), 2, 1e-9),
        (([[0.0]], [[1.0]], [[[3.0]], [[1.0]]], [[0.0]]), 3, 1e-12),  # of a period of two
        (HIDDEN, 4.48499, 2e-6),
    ],
)
def test_closed_forms(system, expected, rel):
    assert float(lbt.hinf_norm(system)) == pytest.approx(expected, rel=rel, abs=0)


def test_norms_of_matrices_of_any_size():
    for size in (5e-324, 1e-310, 1e-150, 1e300):
        assert spectral_norms(np.full((1, 2, 2), complex(size)))[0] == 2 * size
    beside = np.stack([np.eye(2), np.full((2, 2), np.nan), np.full((2, 2), np.inf)])
    np.testing.assert_array_equal(spectral_norms(beside + 0j), [1, np.nan, np.nan])


DEAF = StateSpace(A=np.zeros((2, 2, 2)), B=np.zeros((2, 0)), C=np.ones((1, 2)), D=np.zeros((1, 0)))
WALK, LAG = (StateSpace(A=pole, B=1.0, C=1.0, D=0.0) for pole in (1.0, 0.5))


def test_refusals(monkeypatch):
    unstable = [[1.5]], [[1.0]], [[1.0]], [[0.0]]
    rows = [
        (lambda: lbt.hinf_norm("system"), ProblemError, "got str"),
        (lambda: lbt.hinf_norm(DEAF), DimensionError, "0 inputs and 1 outputs"),
        (lambda: largest_real_part(WALK), UnstableLoopError, "a pole of modulus 1"),
        (lambda: band_norm(WALK, 0, 0.5), NumericalError, "at 0 Hz is not finite"),
        (lambda: lbt.hinf_norm(unstable), UnstableLoopError, "got a pole of modulus 1.5"),
    ]
    require_refusals(rows)
    assert refused(*rows[-1]).spectral_radius == 1.5
    failure = Mock(side_effect=np.linalg.LinAlgError("ggev"))
    monkeypatch.setattr("lbt_synth.linear.norms.eigvals", failure)
    refused(lambda: lbt.hinf_norm(LAG), NumericalError, "scale the states")


def test_a_narrow_peak_is_found_and_placed():
    line = lbt.Vibration(frequency_hz=133.7, damping=1e-7, rms_nm=1).ar_model(800)
    system = StateSpace(A=line.companion, B=np.eye(2, 1), C=np.eye(1, 2), D=0, dt_s=1 / 800)
    norm, pole = lbt.hinf_norm(system), np.exp(2j * np.pi * 133.7 / 800)
    assert norm.peak_frequency_hz == pytest.approx(133.7, rel=1e-6)
    response = abs(system.frequency_response([norm.peak_frequency_hz])[0, 0, 0])
    assert norm.value == pytest.approx(response, rel=1e-12)
    decay = 1 - abs(line.coefficients[1]) ** 0.5
    assert norm.value == pytest.approx(1 / abs(decay * (pole - 1 / pole)), rel=1e-3)


@given(
    seed=st.integers(0, 100_000), n=st.integers(1, 4), scale=st.sampled_from([1e-9, 1e-5, 1e5, 1e9])
)
def test_units_of_states_change_nothing(seed, n, scale):
    """B s, C / s, and each state in units of its own."""
    A, B, C, D = random_system(seed, n, 2, 2, 0.9)
    units = 10.0 ** np.random.default_rng(seed).uniform(-6, 6, n)
    turned = (A * units[:, None] / units, B * units[:, None], C / units, D)
    systems = (A, B, C, D), (A, scale * B, C / scale, D), turned
    expected, *norms = (float(lbt.hinf_norm(system)) for system in systems)
    assert norms == pytest.approx([expected] * 2, rel=1e-9)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 6), m=st.integers(1, 3))
def test_peaks_of_a_band_and_of_the_real_part_against_a_dense_grid(seed, n, m):
    rng = np.random.default_rng(seed)
    A, B, C, D = random_system(seed, n, m, m, rng.uniform(0.3, 0.99))
    system = lbt.linear.StateSpace(A=A, B=B, C=C, D=D)
    response = system.frequency_response(np.linspace(0, 0.5, 20001))
    hermitian = np.linalg.eigvalsh((response + response.conj().transpose(0, 2, 1)) / 2)
    dense, size = np.max(hermitian), np.max(np.abs(response))
    assert dense - 1e-9 * size <= largest_real_part(system) <= dense + 1e-3 * size
    low, high = np.sort(rng.uniform(0, 0.5, 2))
    inside = system.frequency_response(np.linspace(low, high, 4001))
    dense = np.max(np.linalg.norm(inside, 2, (1, 2)))
    norm = band_norm(system, low, high)
    assert dense * (1 - 1e-10) <= norm.upper <= dense * 1.001
    assert low <= norm.peak_frequency_hz <= high


@pytest.mark.parametrize("through", [0.0, 3.0])
def test_the_norm_of_independent_parts_is_the_largest_of_theirs(through):
    """Two equal lags, a third one, a state that nothing moves, and a path without states."""
    A, B, C, D = map(
        np.diag, ([0.5, 0.8, 0.5, 0.99], [1, 1, 1, 0], [1, 0.3, 1, 0], [0, 0, 0, through])
    )
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 4)))[0]
    for one, parts in ((np.eye(4), 1 if through else 2), (turn, 1)):
        system = StateSpace(A=one @ A @ one.T, B=one @ B, C=C @ one.T, D=D)
        assert len(independent_parts(system)) == parts
        assert float(lbt.hinf_norm(system)) == pytest.approx(max(2.0, through))
