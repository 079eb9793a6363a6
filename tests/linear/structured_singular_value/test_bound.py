"""Bounds over all frequencies, against unitary uncertainties and poles."""

from __future__ import annotations

import numpy as np
import pytest
from support.blocks import random_uncertainty

import lbt_synth as lbt
from lbt_synth.linear import Block, StateSpace, mu_bound
from lbt_synth.linear.structured_singular_value.bound import upper_bound


def channel_bound(system):
    return upper_bound(system, [Block()] * len(system.C), 1e-4)


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
    upper, angles = channel_bound(system)
    poles = np.abs(np.angle(system.poles)) / (2 * np.pi)
    frequencies = np.concatenate([np.linspace(0, 0.5, 501), poles, [angles[0] / (2 * np.pi)]])
    best = attained(system, frequencies, np.exp(1j * np.linspace(0, 2 * np.pi, 91)))
    assert best <= upper * (1 + 1e-9)
    assert upper <= best * 1.002
    assert upper <= lbt.hinf_norm(system).upper * (1 + 1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_three_channels_stay_below_the_bound(seed):
    system = random_system(100 + seed, 3)
    best = attained(system, np.linspace(0, 0.5, 101), np.exp(1j * np.linspace(0, 2 * np.pi, 25)))
    assert best <= channel_bound(system)[0] * (1 + 1e-9)


def test_channels_that_do_not_meet_are_as_bad_as_the_worst():
    lags = StateSpace(A=np.diag([0.5, 0.9]), B=np.eye(2), C=np.eye(2), D=np.zeros((2, 2)))
    assert channel_bound(lags)[0] == pytest.approx(10, rel=2e-4)


def test_one_channel_is_the_norm():
    lag = StateSpace(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    assert channel_bound(lag)[0] == lbt.hinf_norm(lag).upper


def test_nothing_has_no_norm():
    zero = StateSpace(A=[[0.5]], B=np.zeros((1, 2)), C=np.zeros((2, 1)), D=np.zeros((2, 2)))
    assert channel_bound(zero)[0] == 0


BLOCKS = {
    "full": (Block(), Block(size=2)),
    "repeated": (Block(), Block(size=2, kind="complex")),
    "mixed": (Block(kind="real"), Block(size=2)),
    "repeated real": (Block(), Block(size=2, kind="real")),
}


@pytest.mark.parametrize("name", BLOCKS)
def test_uncertainties_that_keep_and_that_destroy_stability(name):
    blocks = BLOCKS[name]
    system = random_system(40, 3)
    found = mu_bound(system, blocks, tolerance=1e-2)
    assert 0.9 * found.upper <= found.lower <= found.upper
    response = system.frequency_response([found.delta_frequency_hz])[0]
    assert np.linalg.svd(np.eye(3) - response @ found.delta)[1][-1] < 1e-9
    assert np.linalg.norm(found.delta, 2) == pytest.approx(1 / found.lower)
    # the largest response of the scaled system between the points of the grid
    finer = system.frequency_response(np.linspace(0, 0.5, 2001))
    rng = np.random.default_rng(3)
    for _ in range(20):
        delta = random_uncertainty(rng, blocks)
        real = name.endswith(("mixed", "real"))
        if not real:
            assert np.abs(np.linalg.eigvals(finer @ (delta / found.upper))).max() <= 1
            continue
        closed = system.A + system.B @ np.linalg.solve(
            np.eye(3) - delta / found.upper @ system.D, delta / found.upper @ system.C
        )
        assert np.abs(np.linalg.eigvals(closed)).max() < 1


def test_the_bound_of_a_matrix_knows_no_frequency():
    found = mu_bound([[0.0, 2.0], [8.0, 0.0]], (Block(), Block()))
    assert found.upper == pytest.approx(4)
    assert found.lower == pytest.approx(4)
    assert np.isnan(found.frequency_hz)


def test_a_real_number_that_cannot_make_a_matrix_singular():
    found = mu_bound([[2j]], [Block(kind="real")])
    assert found.upper < 1e-3
    assert found.lower == 0
    assert found.delta is None
    assert mu_bound([[-2.0]], [Block(kind="real")]).lower == pytest.approx(2)


def test_an_unstable_system_is_refused():
    growing = StateSpace(A=[[1.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    with pytest.raises(lbt.errors.UnstableLoopError, match="stable"):
        mu_bound(growing, [Block()])
