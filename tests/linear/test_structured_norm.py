"""The structured norm, against the largest spectral radius over unitary uncertainties."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear import StateSpace, structured_norm


def random_system(seed, channels):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 12))
    A = rng.normal(size=(n, n))
    A *= rng.choice([0.5, 0.9, 0.99, 0.9999]) / abs(np.linalg.eigvals(A)).max()
    return StateSpace(
        A=A,
        B=rng.normal(size=(n, channels)) * 10 ** rng.normal(size=(1, channels)),
        C=rng.normal(size=(channels, n)),
        D=rng.normal(size=(channels, channels)),
    )


def attained(system, frequencies, phases):
    """Return the largest spectral radius of U M(f): mu is attained by a unitary diagonal U."""
    response = system.frequency_response(frequencies)
    grid = np.meshgrid(*[phases] * (len(system.C) - 1))
    best = 0.0
    for turn in np.reshape(grid, (len(grid), -1)).T:
        scales = np.concatenate([[1.0], turn])[:, None]
        best = max(best, float(np.abs(np.linalg.eigvals(scales * response)).max()))
    return best


@pytest.mark.parametrize("seed", range(12))
def test_two_channels_attain_the_bound(seed):
    system = random_system(seed, 2)
    norm = structured_norm(system)
    poles = np.abs(np.angle(system.poles)) / (2 * np.pi)
    frequencies = np.concatenate([np.linspace(0, 0.5, 501), poles, [norm.peak_frequency_hz]])
    best = attained(system, frequencies, np.exp(1j * np.linspace(0, 2 * np.pi, 91)))
    assert best <= norm.upper * (1 + 1e-9)
    assert norm.upper <= best * 1.002
    assert norm.value == pytest.approx(norm.upper, rel=1e-4)
    assert norm.upper <= lbt.hinf_norm(system).upper * (1 + 1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_three_channels_stay_below_the_bound(seed):
    system = random_system(100 + seed, 3)
    best = attained(system, np.linspace(0, 0.5, 101), np.exp(1j * np.linspace(0, 2 * np.pi, 25)))
    assert best <= structured_norm(system).upper * (1 + 1e-9)


def test_channels_that_do_not_meet_are_as_bad_as_the_worst():
    lags = StateSpace(A=np.diag([0.5, 0.9]), B=np.eye(2), C=np.eye(2), D=np.zeros((2, 2)))
    assert structured_norm(lags).upper == pytest.approx(10, rel=2e-4)


def test_one_channel_is_the_norm():
    lag = StateSpace(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    assert structured_norm(lag).upper == lbt.hinf_norm(lag).upper


def test_nothing_has_no_norm():
    zero = StateSpace(A=[[0.5]], B=np.zeros((1, 2)), C=np.zeros((2, 1)), D=np.zeros((2, 2)))
    assert structured_norm(zero).value == 0


def test_a_system_that_is_not_square_is_refused():
    tall = StateSpace(A=[[0.5]], B=[[1.0]], C=np.ones((2, 1)), D=np.zeros((2, 1)))
    with pytest.raises(lbt.errors.ProblemError, match="2 outputs for 1 inputs"):
        structured_norm(tall)
