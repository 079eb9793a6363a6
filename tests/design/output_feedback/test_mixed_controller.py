"""Least variance under a bound on the norm."""

import numpy as np
import pytest
from support.common_lyapunov import common_lyapunov_rms
from support.generalized_plants import random_plant

import lbt_synth as lbt
from lbt_synth.errors import InfeasibleError
from lbt_synth.linear.output_feedback.two_riccati import free_parameter, scaled_plant


@pytest.mark.parametrize("seed", [1, 2, 6])
def test_never_worse_than_one_lyapunov_matrix(seed):
    plant = random_plant(seed, n=3, D22=False)
    least, quiet = lbt.hinf_controller(plant), lbt.h2_controller(plant)
    gamma = 0.5 * (least.gamma + quiet.gamma)
    design = lbt.mixed_controller(plant, gamma=gamma, taps=12)
    assert design.gamma <= gamma
    assert quiet.rms * (1 - 1e-9) <= design.rms
    assert design.rms <= common_lyapunov_rms(plant, gamma) * (1 + 1e-4)


def test_variance_is_least_variance_and_size_of_the_filter():
    scaled = scaled_plant(random_plant(3, n=4))
    equations = scaled.equations(0.0)
    loop = free_parameter(equations)
    taps = 0.3 * np.random.default_rng(0).normal(size=(5, *loop.through.shape))
    closed = scaled.plant.closed_loop(loop.controller(taps))
    assert closed.spectral_radius < 1
    least = lbt.h2_controller(scaled.plant).rms
    rms = lbt.design.certificate.certify_error(closed).rms
    assert rms**2 == pytest.approx(least**2 + np.sum(taps**2), rel=1e-9)


def test_loose_bound_gives_the_least_variance():
    plant = random_plant(3, n=3)
    quiet = lbt.h2_controller(plant)
    assert lbt.mixed_controller(plant, gamma=2 * quiet.gamma).rms == pytest.approx(quiet.rms)


def test_bounds_that_cannot_be_met():
    plant = random_plant(3, n=3)
    least = lbt.hinf_controller(plant).gamma_least
    with pytest.raises(InfeasibleError, match="because"):
        lbt.mixed_controller(plant, gamma=0.9 * least)
    with pytest.raises(InfeasibleError, match="with 1 taps"):
        lbt.mixed_controller(plant, gamma=1.002 * least, taps=1)
