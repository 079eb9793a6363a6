"""Controllers of least variance of generalised plants."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from support.generalized_plants import random_plant

import lbt_synth as lbt


@pytest.mark.parametrize("seed", range(8))
def test_no_neighbour_leaves_less(seed):
    """The variance is that of scipy's Lyapunov equation, and least among its neighbours."""
    plant = random_plant(seed, n=4)
    design = lbt.h2_controller(plant)

    def variance(controller):
        loop = plant.closed_loop(controller)
        P = solve_discrete_lyapunov(loop.A, loop.B @ loop.B.T)
        return np.trace(loop.C @ P @ loop.C.T + loop.D @ loop.D.T)

    K = design.controller
    least = variance(K)
    assert design.rms == pytest.approx(np.sqrt(least), rel=1e-9)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        parts = {name: getattr(K, name) for name in "ABCD"}
        moved = {k: v + 1e-4 * rng.normal(size=v.shape) for k, v in parts.items()}
        assert variance(lbt.linear.StateSpace(**moved)) >= least * (1 - 1e-12)


def test_scalar_closed_form():
    """A random walk with unit noises: the fourth power of the rms is 5."""
    plant = lbt.linear.GeneralizedPlant(
        A=1.0,
        B1=[[1.0, 0.0]],
        B2=1.0,
        C1=[[1.0], [0.0]],
        C2=1.0,
        D12=[[0.0], [1.0]],
        D21=[[0.0, 1.0]],
    )
    assert lbt.h2_controller(plant).rms ** 4 == pytest.approx(5.0)
