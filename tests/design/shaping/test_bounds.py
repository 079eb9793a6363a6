"""Demands in the programme, against the real loop."""

import numpy as np
import pytest
from support.shaping import (
    NOISE,
    ONE,
    SLOW,
    channel,
    random_coefficients,
    spec,
)

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import mode_loop


@pytest.mark.parametrize(
    "demand",
    [
        lbt.design.shaping.ModulusMargin(at_least=0.4),
        lbt.design.shaping.NoisePeak(at_most=2),
        lbt.design.shaping.Attenuation(low_hz=3, high_hz=9, at_most=0.7),
        lbt.design.shaping.Attenuation(low_hz=3, high_hz=9, at_most=1.4, sensor_gain=0.5),
        lbt.design.shaping.LoopErrors(low=0.4, high=1.0),
        lbt.design.shaping.LoopErrors(low=1.0, high=1.5),
        lbt.design.shaping.MirrorUncertainty(relative=0.4, low_hz=100, high_hz=400),
        lbt.design.shaping.LoopErrors(delay_frames=0.3),
        lbt.design.shaping.CommandRms(at_most_nm=30, turbulence=SLOW, noise_nm=NOISE),
        lbt.design.shaping.CommandRms(at_most_nm=30, turbulence=SLOW, noise_nm=NOISE, rate=True),
    ],
    ids=lambda d: d.label,
)
@pytest.mark.parametrize("seed", range(3))
def test_a_demand_holds_in_the_programme_where_it_holds_in_the_loop(demand, seed):
    mode = channel()
    grid = spec(demand).grid(mode).with_points(np.linspace(0, 400, 4001))
    constraints = demand.constraints(mode, grid)
    for size in (0.02, 0.1, 0.3, 1.0, 3.0):
        c = random_coefficients(12, seed) * size
        held = all(
            x.function.value(c) <= x.limit if hasattr(x, "limit") else np.max(x.use(c)) <= 1
            for x in constraints
        )
        loop = mode_loop(mode.hardware, mode.basis.parameter(c))
        if not loop.at(getattr(demand, "sensor_gain", 1.0)).is_stable:
            continue
        checks = demand.checks(loop)
        if all(abs(check.value / check.limit - 1) > 5e-3 for check in checks):  # not on the edge
            assert held == all(check.passed for check in checks)


@pytest.mark.parametrize(("at_most", "gain"), [(1.6, 1.5), (1.9, 1.5), (2.2, 1.3), (1.7, 0.45)])
def test_attenuation_near_the_edge_of_convexity_is_certified(at_most, gain):
    eager = lbt.design.shaping.ResidualVariance(turbulence=SLOW, noise_nm=2.0)
    mask = lbt.design.shaping.Attenuation(low_hz=0, high_hz=400, at_most=at_most, sensor_gain=gain)
    design = lbt.design.shape(ONE, spec(mask, objective=eager), functions=20, states=None)
    f = np.linspace(0, 400, 8001)
    loop = lbt.close_loop(ONE, design.controller, sensor_gain=gain)
    assert np.max(np.abs(loop.sensitivity(f))) < at_most
