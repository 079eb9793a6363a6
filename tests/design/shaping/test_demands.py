"""Demands in the programme, against the real loop and against loops that differ."""

from dataclasses import replace

import numpy as np
import pytest
from support.shaping import (
    NOISE,
    ONE,
    RATE,
    SLOW,
    attenuation,
    channel,
    margin,
    random_coefficients,
    shaped,
    spec,
)

import lbt_synth as lbt
from lbt_synth.design import shaping
from lbt_synth.design.shaping import Bound, CommandRms, LoopErrors
from lbt_synth.design.shaping.channel import mode_loop
from lbt_synth.storage.display_unit import own_display_unit, show_in

DEMANDS = [
    margin(0.4),
    Bound(response="noise", at_most=2),
    attenuation(3, 9, 0.7),
    attenuation(3, 9, 1.4, sensor_gain=0.5),
    LoopErrors(low=0.4, high=1.0),
    LoopErrors(low=1.0, high=1.5),
    Bound(response="complementary", at_most=2.5, low_hz=100, high_hz=400),
    LoopErrors(delay_frames=0.3),
    LoopErrors(low=0.75, high=1.333, delay_frames=0.2),
    CommandRms(at_most_nm=30, turbulence=SLOW, noise_nm=NOISE),
    CommandRms(at_most_nm=30, turbulence=SLOW, noise_nm=NOISE, rate=True),
]


@pytest.mark.parametrize("demand", DEMANDS, ids=lambda d: d.label)
def test_a_demand_holds_in_the_programme_where_it_holds_in_the_loop(demand):
    mode = channel()
    grid = replace(spec(demand).grid(mode), points_hz=np.linspace(0, 400, 4001))
    constraints = demand.constraints(mode, grid)
    for size, seed in ((s, i) for s in (0.02, 0.1, 0.3, 1.0, 3.0) for i in range(3)):
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


@pytest.mark.parametrize(("at_most", "gain"), [(1.9, 1.5), (1.7, 0.45)])
def test_attenuation_near_the_edge_of_convexity_is_certified(at_most, gain):
    eager = shaping.ResidualVariance(turbulence=SLOW, noise_nm=2.0)
    mask = attenuation(0, 400, at_most, sensor_gain=gain)
    loop = lbt.close_loop(ONE, shaped(mask, terms=[eager]).controller, sensor_gain=gain)
    assert np.max(np.abs(loop.sensitivity(np.linspace(0, 400, 8001)))) < at_most


@pytest.mark.parametrize(("delay", "error"), [(1.5, 0.3), (2.0, 1.0), (2.5, 0.5), (3.0, 0.6)])
def test_a_loop_is_stable_at_every_delay_within_its_error(delay, error):
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    eager = shaping.ResidualVariance(turbulence=SLOW, noise_nm=1.0)
    design = shaped(LoopErrors(delay_frames=error), terms=[eager], path=path)
    for e in np.linspace(-error, error, 41):
        real = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=max(delay + e, 1.0), modes=1)
        assert lbt.close_loop(real, design.controller).is_stable
    if delay == 2.0:  # without the demand it is not
        late = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=3.0, modes=1)
        free = shaped(terms=[eager], path=path)
        assert not lbt.close_loop(late, free.controller).is_stable


LINE = shaping.VibrationBand(low_hz=16, high_hz=24, rms_nm=500)


def shape_for_a_gain(low, high, *, moving):
    """Return one design, and the check of a gain that moves in its interval."""
    errors = LoopErrors(low=low, high=high, moving=moving)
    design = shaped(errors, terms=[LINE], functions=12)
    moves = LoopErrors(low=low, high=high, moving=True)
    return design, moves.checks(mode_loop(ONE, design.parameters[0]))[-1]


def test_a_moving_gain_is_proved_where_constant_ones_are_not_enough():
    """A switch between stable gains breaks the loop that the circle criterion does not prove."""
    still, failed = shape_for_a_gain(0.3, 1.5, moving=False)
    moves, passed = shape_for_a_gain(0.3, 1.5, moving=True)
    assert (passed.passed, failed.passed) == (True, False)
    assert passed.name == "circle criterion of a moving gain, 0.3 to 1.5"
    low, high = (
        lbt.close_loop(still.hardware, still, sensor_gain=gain).system for gain in (0.3, 1.5)
    )
    assert max(low.spectral_radius, high.spectral_radius) < 1
    power, turns = np.linalg.matrix_power, range(1, 13)
    switched = [power(low.A, p) @ power(high.A, q) for p in turns for q in turns]
    assert np.max(np.abs(np.linalg.eigvals(switched))) > 1
    assert moves.objective_nm[0] > still.objective_nm[0]


@pytest.mark.parametrize(("low", "high"), [(0.3, 1.0), (1.0, 1.5)])
def test_a_gain_that_moves_on_one_side_costs_nothing(low, high):
    """The disc is a half-plane then, the same as for a constant gain."""
    still, check = shape_for_a_gain(low, high, moving=False)
    assert check.passed
    moves, _ = shape_for_a_gain(low, high, moving=True)
    assert moves.objective_nm == pytest.approx(still.objective_nm, rel=1e-6)


def test_a_moving_gain_that_clashes_is_named():
    demands = LoopErrors(low=0.5, high=3.0, moving=True), attenuation(16, 24, 1e-3)
    with pytest.raises(lbt.errors.InfeasibleError) as caught:
        shaped(*demands, terms=[LINE], functions=16)
    assert any("moving sensor gains" in text for text in caught.value.conflict)


def test_a_demand_has_its_limit_in_the_unit():
    step = lbt.design.shaping.CommandRms(at_most_nm=30.0, turbulence=None, noise_nm=5.0)
    with own_display_unit():
        show_in("mas", 10.0)
        assert step.label == "command stroke of at most 3 mas rms"
    assert step.label == "command stroke of at most 30 nm rms"
