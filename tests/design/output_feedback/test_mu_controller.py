"""Controllers for robust performance."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import Block, GeneralizedPlant

SCALARS = (Block(), Block(), Block())


def uncertain_plant():
    """Three channels of very different sizes, which H-infinity synthesis takes as one."""
    return GeneralizedPlant(
        A=np.diag([0.95, 0.8, 0.3]),
        B1=[[2.0, -0.16, 0.0], [-9.0, 0.0, 0.0], [0.0, 0.03, 0.0]],
        B2=[[0.0], [-0.5], [-1.8]],
        C1=[[0.12, -0.01, -0.02], [-0.05, 0.06, -0.07], [0.0, 0.0, 0.0]],
        C2=[[-0.1, 0.2, -1.2]],
        D12=[[0.0], [0.0], [1.0]],
        D21=[[0.0, 0.0, 0.3]],
    )


@cache
def hinf_design():
    """The design for the norm alone."""
    return lbt.hinf_controller(uncertain_plant())


@cache
def hinf_mu():
    """The bound of its loop."""
    return lbt.linear.mu_bound(hinf_design().closed_loop, SCALARS).upper


@pytest.mark.parametrize("order", [0, 2])
def test_scales_beat_the_norm(order):
    design = lbt.mu_controller(uncertain_plant(), SCALARS, order=order)
    assert design.mu < 0.8 * hinf_mu()
    assert design.certificate.passed
    assert design.mu == lbt.linear.mu_bound(design.closed_loop, SCALARS).upper


def test_uncertainty_below_the_bound_does_not_destabilise():
    design = lbt.mu_controller(uncertain_plant(), SCALARS)
    loop, rng = design.closed_loop, np.random.default_rng(0)
    for _ in range(200):
        delta = np.diag(rng.uniform(-1, 1, size=3)) * 0.999 / design.mu
        closed = np.linalg.solve(np.eye(3) - loop.D @ delta, loop.C)
        assert np.max(np.abs(np.linalg.eigvals(loop.A + loop.B @ delta @ closed))) < 1


def test_one_full_block_is_the_norm():
    design = lbt.mu_controller(uncertain_plant(), (Block(size=3),))
    assert design.mu == pytest.approx(1.02 * hinf_design().gamma, rel=0.02)


def test_bad_problems():
    plant = uncertain_plant()
    with pytest.raises(DimensionError, match="blocks must take"):
        lbt.mu_controller(plant, (Block(), Block()))
    with pytest.raises(ProblemError, match="order must be at most 3"):
        lbt.mu_controller(plant, SCALARS, order=4)
    continuous = GeneralizedPlant(A=-1.0, B1=1.0, B2=1.0, C1=1.0, C2=1.0, dt_s=None)
    with pytest.raises(ProblemError, match="discrete time"):
        lbt.mu_controller(continuous, (Block(),))
