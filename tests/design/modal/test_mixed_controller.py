"""Mixed controllers: steps written out, loops, refusals."""

import numpy as np
from support.effort import count_calls
from support.modal import path_of, some_air, tip_tilt_filter
from support.refusals import require_refusals

from lbt_synth.design.modal import MixedController, modal_filters
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError


def written_out(controller, gains, leak, filtered, series):
    """Return the commands of the recursion, mode by mode in plain Python."""
    run = controller.start()
    n = len(gains)
    u, out = [0.0] * n, []
    for modal in series:
        new = [leak[i] * u[i] + gains[i] * modal[i] for i in range(n)]
        command = run.step([modal[i] for i in filtered])
        for i, value in zip(filtered, command, strict=True):
            new[i] = float(value)
        u = new
        out.append(list(u))
    return np.array(out)


def test_step_is_the_recursion_written_out():
    rng = np.random.default_rng(3)
    kalman = tip_tilt_filter()
    gains, leak = rng.uniform(0, 1, 5), rng.uniform(0.9, 1, 5)
    series = 30 * rng.standard_normal((60, 5))
    expected = written_out(kalman.controller, gains, leak, (3, 1), series)
    for filters in (kalman, kalman.controller, kalman.controller.start()):
        mixed = MixedController(filter=filters, gains=gains, filtered=(3, 1), leak=leak)
        first = np.array([mixed.step(y) for y in series])
        assert np.allclose(first, expected, atol=1e-9)
        mixed.reset()
        assert np.array_equal([mixed.step(y) for y in series], first)


def test_commands_are_the_callers():
    mixed = MixedController(gains=[1.0, 1.0])
    mixed.step([1.0, 2.0])[:] = 1e9
    assert mixed.step([0.0, 0.0]).tolist() == [1.0, 2.0]


def test_a_step_of_672_modes_enters_as_many_functions_as_one_of_two():
    few, many = (
        MixedController(filter=tip_tilt_filter(), gains=np.full(modes, 0.4)) for modes in (2, 672)
    )
    many.step(np.ones(672))  # what only the first step does
    assert count_calls(many.step, np.ones(672)) <= count_calls(few.step, np.ones(2)) < 100


def test_bad_mixed_controllers_are_refused():
    kalman = tip_tilt_filter()
    gains = np.full(5, 0.4)

    def mixed(gains=gains, **options):
        return lambda: MixedController(gains=gains, **options)

    two = modal_filters(some_air(2), hardware=path_of(), noise_nm=1.0)
    require_refusals(
        [
            (mixed(0.4, filter=kalman), DimensionError, "gains must be a list"),
            (mixed([0.4, np.nan], filter=kalman), NonFiniteError, "gains must be finite"),
            (mixed([-0.1]), ProblemError, "gains must be at least 0"),
            (mixed(leak=1.1), ProblemError, "leak must be .*at most 1"),
            (mixed(leak=[1, 1]), DimensionError, "leak must be one"),
            (mixed(filter=kalman, filtered=(0,)), DimensionError, "1 filtered"),
            (mixed(filter=kalman, filtered=(0, 5)), ProblemError, "at most 4"),
            (mixed(filter=kalman, filtered=(1, 1)), ProblemError, "different mode numbers"),
            (mixed(filter=kalman, filtered=()), ProblemError, "at least one; got"),
            (mixed(filter=two, filtered=(0,)), DimensionError, "the 1 filtered modes; got 2"),
            (mixed(filter=3), ProblemError, "filter must be a design"),
        ]
    )


def test_bad_measurements_leave_the_state_alone():
    mixed = MixedController(gains=[1.0, 1.0])
    mixed.step([1.0, 2.0])
    rows = [
        (lambda: mixed.step([1.0]), DimensionError, r"y must have shape \(2,\)"),
        (lambda: mixed.step([np.nan, 1.0]), NonFiniteError, "The state is as before"),
        (lambda: mixed.step("a"), ProblemError, "array of numbers"),
        (lambda: mixed.step(["1.0", "2.0"]), ProblemError, "array of numbers"),
        (lambda: mixed.step([1j, 1j]), ProblemError, "real"),
    ]
    require_refusals(rows)
    assert mixed.step([0.0, 0.0]).tolist() == [1.0, 2.0]
