"""Demands in the programme, against loops that differ; demands that clash or are violated."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.ensembles import plant as plant_with
from support.refusals import refused
from support.shaping import BASIC, NOISE, ONE, SLOW, attenuation, channel, margin, shaped, spec
from support.shaping import random_coefficients as drawn

import lbt_synth as lbt
from lbt_synth.design import shaping
from lbt_synth.design.shaping import Bound, CommandRms, LoopErrors
from lbt_synth.design.shaping.channel import mode_loop
from lbt_synth.design.shaping.solution import solve_mode
from lbt_synth.design.shaping.specification import violated_demands
from lbt_synth.errors import InfeasibleError
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
    for c in (drawn(12, seed) * s for s in (0.02, 0.1, 0.3, 1.0, 3.0) for seed in range(3)):
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
    eager = [shaping.ResidualVariance(turbulence=SLOW, noise_nm=1.0)]
    path = replace(ONE, delay_frames=delay)
    design = shaped(LoopErrors(delay_frames=error), terms=eager, path=path)
    for late in np.maximum(delay + np.linspace(-error, error, 41), 1.0):
        assert lbt.close_loop(replace(ONE, delay_frames=late), design.controller).is_stable
    if delay == 2.0:  # without the demand it is not
        free = shaped(terms=eager).controller
        assert not lbt.close_loop(replace(ONE, delay_frames=3.0), free).is_stable


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
    loops = [lbt.close_loop(still.hardware, still, sensor_gain=gain) for gain in (0.3, 1.5)]
    assert all(loop.is_stable for loop in loops)
    low, high = ([np.linalg.matrix_power(x.system.A, p) for p in range(1, 13)] for x in loops)
    switched = [one @ other for one in low for other in high]
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
    error = refused(lambda: shaped(*demands, terms=[LINE], functions=16), InfeasibleError, ".")
    assert any("moving sensor gains" in label for label in error.conflict)


def test_a_demand_has_its_limit_in_the_unit():
    step = lbt.design.shaping.CommandRms(at_most_nm=30.0, turbulence=None, noise_nm=5.0)
    with own_display_unit():
        show_in("mas", 10.0)
        assert step.label == "command stroke of at most 3 mas rms"
    assert step.label == "command stroke of at most 30 nm rms"


def test_terms_at_other_sensor_gains_are_lowered_step_by_step():
    weak = spec(margin(0.4), terms=[BASIC, replace(BASIC, sensor_gain=0.4)])
    objectives = np.array(solve_mode(weak, channel(16)).objectives_nm2)
    assert len(objectives) > 2
    assert np.all(np.diff(objectives) <= 1e-3 * objectives[:-1])
    unaware = solve_mode(spec(margin(0.4), LoopErrors(low=0.4, high=1)), channel(16))
    assert objectives[-1] < weak.measured_nm2(mode_loop(ONE, unaware.parameter))


def test_a_smallest_set_of_clashing_demands_is_named_with_a_relaxation_that_suffices():
    deep, stiff = attenuation(0, 50, 0.2), margin(0.7)
    others = Bound(response="noise", at_most=50), LoopErrors(low=0.9, high=1.1)
    call = partial(shaped, others[0], deep, others[1], stiff, functions=16)
    error = refused(call, InfeasibleError, "hold together with 16 functions")
    assert set(error.conflict) == {deep.label, stiff.label}
    factor = float(str(error).split("relaxed by a factor of ")[1].split(")")[0])
    relaxed = replace(deep, at_most=0.2 * factor * 1.01)
    assert shaped(relaxed, stiff, functions=16).certificate.passed


def test_one_demand_may_be_impossible_by_itself():
    # with a delay of two frames the first two samples of S are 1 and 0: |S| < 1 everywhere fails
    call = partial(shaped, attenuation(0, 400, 0.9), functions=12)
    assert len(refused(call, InfeasibleError, "these demands cannot hold with").conflict) == 1


@pytest.fixture(scope="module")
def design():
    bands = [shaping.VibrationBand(low_hz=18, high_hz=22, rms_nm=100)]
    return lbt.robust(plant_with(), bands=bands, sensor_gain=(0.5, 1.5), functions=16, states=None)


def violated(design, controller):
    return violated_demands(design.specifications, design.hardware, controller)


WEAK = "modulus margin of at least 0.45"
NARROW = "stability for sensor gains 0.5 to 1.5 and delay errors up to 0.1 frames"


def test_an_integrator_violates_what_its_margins_say(design):
    low, high = (lbt.integrator(design.hardware, gain=gain) for gain in (0.2, 0.9))
    assert violated(design, low.controller) == violated(design, design.controller) == ()
    assert lbt.loop_margins(lbt.close_loop(design.hardware, high.controller)).modulus < 0.45
    assert violated(design, high.controller) == (WEAK, NARROW)


def test_a_filter_with_poles_outside_the_circle_on_one_axis_is_judged_on_each(design):
    controller = lbt.kalman(plant_with(noise_nm=5.0)).controller
    assert np.max(np.abs(np.linalg.eigvals(controller.A))) > 1
    margins = lbt.loop_margins(lbt.close_loop(design.hardware, controller))
    expected = [WEAK] * (margins.modulus < 0.45)
    expected += [NARROW] * (margins.gain_low > 0.5 or margins.gain_high < 1.5)
    assert list(violated(design, controller)) == expected


def test_coupled_axes_are_not_judged(design):
    across = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100, direction=(1, 1))
    assert violated(design, lbt.kalman(plant_with(vibrations=[across])).controller) is None
