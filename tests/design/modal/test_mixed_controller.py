"""Mixed controllers: steps written out, loops, refusals."""

import numpy as np
import pytest
from support.effort import count_calls
from support.interaction import interaction
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design.modal import MixedController, reconstructor


def written_out(filter_controller, gains, leak, filtered, slopes, inverse):
    """The recursion, mode by mode in plain Python."""
    run = filter_controller.start()
    n = len(gains)
    u, out = [0.0] * n, []
    for y in slopes:
        modal = inverse @ y
        new = [leak[i] * u[i] + gains[i] * modal[i] for i in range(n)]
        command = run.step([modal[i] for i in filtered])
        for i, value in zip(filtered, command, strict=True):
            new[i] = float(value)
        u = new
        out.append(list(u))
    return np.array(out)


def test_step_is_the_recursion_written_out():
    rng = np.random.default_rng(3)
    kalman = lbt.kalman(lbt_axis_plant(modes=2))
    inverse = reconstructor(interaction(9, 5))
    gains, leak = rng.uniform(0, 1, 5), rng.uniform(0.9, 1, 5)
    mixed = MixedController(
        filter=kalman, gains=gains, filtered=(3, 1), leak=leak, reconstructor=inverse
    )
    slopes = 30 * rng.standard_normal((60, 9))
    expected = written_out(kalman.controller, gains, leak, (3, 1), slopes, inverse.matrix)
    for filters in (kalman, kalman.controller, kalman.controller.start()):
        other = MixedController(
            filter=filters, gains=gains, filtered=(3, 1), leak=leak, reconstructor=inverse
        )
        assert np.allclose([other.step(y) for y in slopes], expected, atol=1e-9)
    first = np.array([mixed.step(y) for y in slopes])
    mixed.reset()
    assert np.array_equal([mixed.step(y) for y in slopes], first)
    run = mixed.as_controller().start()
    assert np.allclose([run.step(y) for y in slopes], expected, atol=1e-8)
    assert (mixed.n_modes, mixed.n_measurements) == (5, 9)


def test_commands_are_the_callers():
    mixed = MixedController(gains=[1.0, 1.0])
    mixed.step([1.0, 2.0])[:] = 1e9
    assert mixed.step([0.0, 0.0]).tolist() == [1.0, 2.0]


def test_two_modes_in_the_loop_agree_with_the_exact_budget():
    plant = lbt_axis_plant(modes=2)
    truth = lbt.Truth(
        turbulence=plant.turbulence[0], vibrations=plant.vibrations[:1], noise_nm=15.5
    )
    for mixed, gain in (
        (MixedController(filter=lbt.kalman(plant), gains=[0, 0]), None),
        (MixedController(gains=[0.4, 0.4]), 0.4),
    ):
        controller = (
            lbt.kalman(plant).controller
            if gain is None
            else lbt.integrator(plant.hardware, gain=gain).controller
        )
        loop = lbt.close_loop(plant.hardware, controller)
        exact = lbt.residual_budget(loop, truth, frame_means=True)
        run = lbt.simulate(mixed, truth, hardware=plant.hardware, frames=12_000, seed=2)
        assert run.rms_nm[0] == pytest.approx(exact.rms_nm, rel=0.05)
        same = lbt.simulate(
            controller, truth, hardware=plant.hardware, frames=500, seed=2, settle_frames=1000
        )
        short = lbt.simulate(mixed, truth, hardware=plant.hardware, frames=500, seed=2)
        assert np.allclose(short.residual_nm, same.residual_nm, atol=1e-7)


def test_fifty_modes_in_the_loop_agree_with_the_linear_loop():
    n, q = 50, 90
    plant = lbt_axis_plant(modes=2)
    D = interaction(q, n)
    inverse = reconstructor(D)
    hardware = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=D)
    gains = np.linspace(0.2, 0.6, n)
    mixed = MixedController(filter=lbt.kalman(plant), gains=gains, reconstructor=inverse)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    kept = {"frames": 200, "seed": 1, "settle_frames": 50}
    stepped = lbt.simulate(mixed, truth, hardware=hardware, **kept)
    linear = lbt.simulate(mixed.as_controller(), truth, hardware=hardware, **kept)
    assert stepped.residual_nm.shape == (1, 200, n)
    assert np.allclose(stepped.residual_nm, linear.residual_nm, atol=1e-7)
    assert np.allclose(stepped.commands, linear.commands, atol=1e-7)


def test_modes_count_for_themselves_only():
    """Any order of the modes gives the same commands in that order."""
    rng = np.random.default_rng(0)
    gains, order = rng.uniform(0, 1, 7), rng.permutation(7)
    kalman = lbt.kalman(lbt_axis_plant(modes=2))
    one = MixedController(filter=kalman, gains=gains, filtered=(0, 1))
    at = [int(np.flatnonzero(order == i)[0]) for i in (0, 1)]
    other = MixedController(filter=kalman, gains=gains[order], filtered=at)
    for _ in range(20):
        y = rng.standard_normal(7)
        assert np.array_equal(one.step(y)[order], other.step(y[order]))


def test_a_step_of_672_modes_enters_as_many_functions_as_one_of_two():
    kalman = lbt.kalman(lbt_axis_plant(modes=2))
    few, many = (MixedController(filter=kalman, gains=np.full(modes, 0.4)) for modes in (2, 672))
    many.step(np.ones(672))  # what only the first step does
    assert count_calls(many.step, np.ones(672)) <= count_calls(few.step, np.ones(2)) < 100


def test_bad_mixed_controllers_are_refused():
    kalman = lbt.kalman(lbt_axis_plant(modes=2))
    inverse = reconstructor(interaction(9, 5))
    gains = np.full(5, 0.4)
    cases = [
        ({"filter": kalman, "gains": 0.4}, lbt.errors.DimensionError, "gains must be a list"),
        (
            {"filter": kalman, "gains": [0.4, np.nan]},
            lbt.errors.NonFiniteError,
            "gains must be finite",
        ),
        ({"filter": None, "gains": [-0.1]}, lbt.errors.ProblemError, "gains must be at least 0"),
        (
            {"filter": None, "gains": gains, "leak": 1.1},
            lbt.errors.ProblemError,
            "leak must be at least 0 and at most 1; got 1.1 to 1.1",
        ),
        (
            {"filter": None, "gains": gains, "leak": [1, 1]},
            lbt.errors.DimensionError,
            "leak must be one",
        ),
        (
            {"filter": kalman, "gains": gains, "filtered": (0,)},
            lbt.errors.DimensionError,
            "1 filtered",
        ),
        (
            {"filter": kalman, "gains": gains, "filtered": (0, 5)},
            lbt.errors.ProblemError,
            "from 0 to 4",
        ),
        (
            {"filter": kalman, "gains": gains, "filtered": ()},
            lbt.errors.ProblemError,
            "at least one mode",
        ),
        ({"filter": 3, "gains": gains}, lbt.errors.ProblemError, "filter must be a design"),
        (
            {"filter": None, "gains": [1, 1], "reconstructor": inverse},
            lbt.errors.DimensionError,
            "per mode of",
        ),
        (
            {"filter": None, "gains": gains, "reconstructor": 1},
            lbt.errors.ProblemError,
            "Reconstructor",
        ),
    ]
    for arguments, error, words in cases:
        with pytest.raises(error, match=words):
            MixedController(**arguments)


def test_bad_measurements_leave_the_state_alone():
    mixed = MixedController(gains=[1.0, 1.0])
    mixed.step([1.0, 2.0])
    with pytest.raises(lbt.errors.DimensionError, match=r"y must have shape \(2,\)"):
        mixed.step([1.0])
    with pytest.raises(lbt.errors.NonFiniteError, match="The state is as before"):
        mixed.step([np.nan, 1.0])
    assert mixed.step([0.0, 0.0]).tolist() == [1.0, 2.0]


def test_a_filter_without_matrices_is_stepped_but_not_linear():
    class Echo:
        def step(self, y):
            return -y

        def reset(self):
            pass

    mixed = MixedController(filter=Echo(), gains=[0.5, 0.5, 0.5], filtered=(2,))
    assert mixed.step([1.0, 1.0, 3.0]).tolist() == [0.5, 0.5, -3.0]
    with pytest.raises(lbt.errors.ProblemError, match="only a filter with matrices"):
        mixed.as_controller()


class Own:
    """A filter that returns what it is told to."""

    def __init__(self, out):
        self.out = out

    def reset(self):
        pass

    def step(self, y):
        return self.out


def test_what_a_filter_returns_is_checked():
    for out, error, words in (
        (5.0, lbt.errors.DimensionError, r"commands must have shape \(2,\).*got \(\)"),
        (np.zeros(3), lbt.errors.DimensionError, r"got \(3,\)"),
        (np.array([1.0, np.nan]), lbt.errors.NonFiniteError, "commands must be finite"),
        (["a", "b"], lbt.errors.ProblemError, "commands must be an array of numbers"),
    ):
        own = Own(np.zeros(2))
        control = MixedController(filter=own, gains=[0.0, 0.0, 0.5])
        assert control.step([1.0, 1.0, 1.0]).tolist() == [0.0, 0.0, 0.5]
        own.out = out
        with pytest.raises(error, match=words):
            control.step([1.0, 1.0, 1.0])
        own.out = np.ones(2)  # the integrators are as before
        assert control.step([1.0, 1.0, 1.0]).tolist() == [1.0, 1.0, 1.0]


def test_measurements_that_are_no_numbers_are_refused():
    control = MixedController(gains=[0.5])
    for y, words in (("a", "array of numbers"), (["1.0"], "array of numbers"), ([1j], "real")):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            control.step(y)
    assert control.step([1]).tolist() == [0.5]
