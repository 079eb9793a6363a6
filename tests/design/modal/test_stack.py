"""A stack of one-mode designs: each is that of kalman, and the loops of all leave what one does."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support import modal
from support.effort import count_calls
from support.lqg import shell
from support.modal import HUM, LINE, RATE, path_of, some_air, tip_tilt_filter
from support.recorded_runs import recorded_run
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.design.modal import MixedController, modal_filters, stack
from lbt_synth.errors import CertificateError, DimensionError, NonFiniteError, ProblemError
from lbt_synth.loop.budget import ensemble_residuals
from lbt_synth.loop.ensemble import LoopEnsemble
from lbt_synth.loop.evaluator import textbook_matrices
from lbt_synth.models import ARModel


@pytest.mark.parametrize(
    ("delay", "order", "mirror"),
    [
        (1, 1, None),
        (1.3, 2, None),
        (2, 2, None),
        (4.5, 1, None),
        (1, 1, shell(500)),
        (2.6, 1, shell(60)),
    ],
)
def test_each_filter_is_that_of_kalman(delay, order, mirror):
    air, noise, gain = some_air(3, order), np.linspace(5, 30, 3), np.linspace(0.5, 1.1, 3)
    facts, lines = {"delay_frames": delay, "mirror": mirror}, ([], [LINE, HUM], [HUM])
    vibrations, hardware = {1: lines[1], 2: HUM}, path_of(**facts)
    met = {"noise_nm": noise, "vibrations": vibrations, "sensor_gain": gain}
    filters = modal_filters(air, hardware=hardware, **met)
    path = filters.hardware
    assert (path.mirror, path.frame_rate_hz, path.delay_frames) == (mirror, RATE, delay)
    for i, mode_lines in enumerate(lines):
        one = lbt.kalman(modal.single_plant(air, i, mode_lines, noise[i], gain[i], **facts))
        mine = filters.design(i)
        assert np.array_equal(mine.gain_predictor, one.gain_predictor)
        for name in "ABCD":
            assert np.array_equal(getattr(mine.controller, name), getattr(one.controller, name))
        sizes = [line.rms_nm / np.sinc(line.frequency_hz / RATE) for line in mode_lines]
        moving = [replace(x, rms_nm=rms) for x, rms in zip(mode_lines, sizes, strict=True)]
        truth = lbt.Truth(turbulence=air.take(i), vibrations=moving, noise_nm=noise[i])
        path = path_of(sensor_matrix=[[gain[i]]], **facts)
        budget = lbt.residual_budget(lbt.close_loop(path, one.controller), truth)
        assert filters.rms_nm[i] == pytest.approx(budget.rms_nm, rel=1e-8)


def test_equal_modes_share_a_design():
    slow, fast = map(some_air(2).take, (0, 1))
    facts = {"noise_nm": [5.0, 5.0, 5.0, 6.0, 5.0], "vibrations": {4: LINE}}
    filters = modal_filters([slow, fast, slow, slow, slow], hardware=path_of(), **facts)
    assert filters.which.tolist() == [0, 1, 0, 2, 3]
    assert len(filters.designs) == 4
    assert filters.rms_nm[0] == filters.rms_nm[2]


def test_a_failing_mode_is_named(monkeypatch):
    air = some_air(4)

    def failing(plant):
        if plant.turbulence[0].driving_rms_nm == air.driving_rms_nm[2]:
            raise CertificateError("no good", failed=("distance",))
        return lbt.kalman(plant)

    monkeypatch.setattr(stack, "kalman", failing)
    call = partial(modal_filters, air, hardware=path_of(), noise_nm=10.0)
    error = refused(call, CertificateError, "filter of mode 2: no good")
    assert error.failed == ("distance",)


def test_refusals():
    air, kalman, gains = some_air(3), tip_tilt_filter(), np.full(5, 0.4)

    def filters(noise_nm=1, **options):
        options = {"hardware": path_of(), "noise_nm": noise_nm} | options
        return lambda: modal_filters(air, **options)

    def mixed(gains=gains, **options):
        return lambda: MixedController(gains=gains, **options)

    two = modal_filters(some_air(2), hardware=path_of(), noise_nm=1.0)
    lines, slower = "list of Vibration", path_of(frame_rate_hz=400)
    require_refusals(
        [
            (filters(0.0), ProblemError, "noise_nm must be above 0"),
            (filters([1.0, 2.0]), DimensionError, "one per mode .3."),
            (filters(np.nan), NonFiniteError, "noise_nm"),
            (filters(hardware=3), ProblemError, "hardware must be a LoopHardware"),
            (filters(hardware=slower), ProblemError, "loop's 400 Hz; got 800"),
            (filters(sensor_gain=-1), ProblemError, "sensor_gain must be above 0"),
            (filters(vibrations=[LINE]), ProblemError, "must be a mapping"),
            (filters(vibrations={3: LINE}), ProblemError, "must be at most 2; got 3"),
            (filters(vibrations={0: 3}), ProblemError, lines),
            (filters(vibrations={0: [1]}), ProblemError, lines),
            (lambda: two.design(2), ProblemError, "mode must be at most 1; got 2"),
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


def law(gain, leak=1.0):
    return lbt.Controller(A=leak, B=gain, C=1.0, D=0.0, dt_s=1 / RATE)


def controller_of(kind, n, delay):
    """Return a controller of n modes, and the controllers of some modes that it is made of."""
    air, gains, leak = some_air(n), np.linspace(0.1, 0.3, n), np.linspace(0.98, 1, n)
    facts, filters, filtered = {"hardware": path_of(delay_frames=delay), "noise_nm": 8.0}, None, ()
    if kind == "filters":
        filters, filtered = modal_filters(air, vibrations={0: [LINE]}, **facts), range(n)
    elif kind == "both":
        filters, filtered = modal_filters([air.take(0)] * 2, **facts), (2, 0)
    parts = [((mode,), filters.design(i).controller) for i, mode in enumerate(filtered)]
    if kind == "mixed":
        filters, filtered = tip_tilt_filter(delay), (3, 1)
        parts = [(filtered, filters.controller)]
    parts += [((i,), law(gains[i], leak[i])) for i in range(n) if i not in filtered]
    options = {"filtered": filtered} if filters else {}
    return MixedController(filter=filters, gains=gains, leak=leak, **options), parts


@pytest.mark.parametrize(
    ("kind", "delay"), [("integrators", 2.7), ("filters", 1.4), ("mixed", 1), ("both", 3)]
)
def test_stepped_modes_are_the_linear_controller_of_all(kind, delay):
    n, frames = 5, 900  # some filters alone grow by 1.04 a frame
    controller, parts = controller_of(kind, n, delay)
    total, noise = np.random.default_rng(4).standard_normal((2, frames, n)) * [[[100]], [[8]]]
    path = path_of(delay_frames=delay, sensor_matrix=np.diag(np.linspace(0.6, 1.1, n)))
    joint = modal.joint_controller(parts, n)
    stepped, linear = (recorded_run(k, path, total, noise) for k in (controller, joint))
    assert np.allclose(stepped, linear, atol=1e-10 * np.abs(linear).max())


def test_a_process_that_is_all_but_a_walk_leaves_what_a_walk_leaves():
    """The residual under a random walk is AR2, ``e(k+1) = e(k) - g e(k-1) + v + g n``."""
    g, v, n = 0.5, 10.0, 5.0
    walk = np.sqrt((1 + g) / ((1 - g) * ((1 + g) ** 2 - 1)) * (v**2 + g**2 * n**2))
    facts, path = {"driving_rms_nm": [1.0, v], "frame_rate_hz": RATE}, path_of(modes=1)
    for distance in (1e-7, 1e-12, 1e-15):
        air = ARModel(coefficients=[[0.9], [1 - distance]], **facts)
        ensemble = LoopEnsemble(loops=2, turbulence=[air], noise_nm=[[n], [n]])
        matrices = textbook_matrices([law(g)])
        left = ensemble_residuals(matrices, path, ensemble, frame_means=True)
        assert left.rms_nm[1] == pytest.approx(walk, rel=1e-7)


def test_a_filter_is_a_design_a_controller_or_a_run_and_begins_again():
    kalman, series = tip_tilt_filter(), np.random.default_rng(3).standard_normal((60, 5))
    commands = []
    for filters in (kalman, kalman.controller, kalman.controller.start()):
        mixed = MixedController(filter=filters, gains=np.full(5, 0.4), filtered=(3, 1))
        for _ in range(2):
            commands.append([mixed.step(y) for y in series])
            mixed.reset()
    np.testing.assert_array_equal(commands, commands[:1] * 6)


def test_a_step_of_672_modes_enters_as_many_functions_as_one_of_two():
    kalman, gains = tip_tilt_filter(), (np.full(modes, 0.4) for modes in (2, 672))
    few, many = (MixedController(filter=kalman, gains=numbers) for numbers in gains)
    many.step(np.ones(672))  # what only the first step does
    assert count_calls(many.step, np.ones(672)) <= count_calls(few.step, np.ones(2)) < 100


def test_bad_measurements_leave_the_state_alone():
    mixed = MixedController(gains=[1.0, 1.0])
    mixed.step([1.0, 2.0])[:] = 1e9  # commands are the caller's
    rows = [
        (lambda: mixed.step([1.0]), DimensionError, r"y must have shape \(2,\)"),
        (lambda: mixed.step([np.nan, 1.0]), NonFiniteError, "The state is as before"),
        (lambda: mixed.step("a"), ProblemError, "array of numbers"),
        (lambda: mixed.step(["1.0", "2.0"]), ProblemError, "array of numbers"),
        (lambda: mixed.step([1j, 1j]), ProblemError, "real"),
    ]
    require_refusals(rows)
    assert mixed.step([0.0, 0.0]).tolist() == [1.0, 2.0]
