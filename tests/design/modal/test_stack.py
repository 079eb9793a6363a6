"""A stack of one-mode designs: each is that of kalman, and the loops of all leave what one does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from support.modal import (
    HUM,
    LINE,
    RATE,
    integrator_residuals,
    joint_controller,
    path_of,
    single_plant,
    some_air,
    tip_tilt_filter,
)
from support.recorded_runs import recorded_run
from support.refusals import require_refusals

import lbt_synth as lbt
import lbt_synth.design.modal.stack
from lbt_synth.design.modal import MixedController, modal_filters, modal_residuals
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError, UnstableLoopError
from lbt_synth.models import ARModel, PositionLoop


@pytest.mark.parametrize(
    ("delay", "order", "bandwidth"),
    [(1, 1, None), (1.3, 2, None), (2, 2, None), (4.5, 1, None), (1, 1, 500.0), (2.6, 1, 60.0)],
)
def test_each_filter_is_that_of_kalman(delay, order, bandwidth):
    n, shell = 3, None
    if bandwidth is not None:
        shell = PositionLoop.from_bandwidth(
            natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth
        )
    air = some_air(n, order)
    noise, gain = np.linspace(5, 30, n), np.linspace(0.5, 1.1, n)
    known = {"delay_frames": delay, "mirror": shell}
    conditions = {"noise_nm": noise, "vibrations": {1: [LINE, HUM], 2: HUM}, "sensor_gain": gain}
    conditions["hardware"] = path_of(**known)
    filters = modal_filters(air, **conditions)
    path = filters.hardware
    assert (path.mirror, path.frame_rate_hz, path.delay_frames) == (shell, RATE, delay)
    exact = modal_residuals(filters, air, **conditions)
    assert np.allclose(exact, filters.rms_nm, rtol=1e-9)
    for i, mode_lines in enumerate(([], [LINE, HUM], [HUM])):
        one = lbt.kalman(single_plant(air, i, mode_lines, noise[i], gain[i], **known))
        mine = filters.design(i)
        assert np.array_equal(mine.gain_predictor, one.gain_predictor)
        for name in "ABCD":
            assert np.array_equal(getattr(mine.controller, name), getattr(one.controller, name))
        moving = [
            replace(line, rms_nm=line.rms_nm / np.sinc(line.frequency_hz / RATE))
            for line in mode_lines
        ]
        truth = lbt.Truth(turbulence=air.take(i), vibrations=moving, noise_nm=noise[i])
        path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[gain[i]]], **known)
        budget = lbt.residual_budget(lbt.close_loop(path, one.controller), truth)
        assert filters.rms_nm[i] == pytest.approx(budget.rms_nm, rel=1e-8)


def test_equal_modes_share_a_design():
    air = some_air(2)
    slow, fast = air.take(0), air.take(1)
    known = {"noise_nm": [5.0, 5.0, 5.0, 6.0, 5.0], "vibrations": {4: LINE}}
    filters = modal_filters([slow, fast, slow, slow, slow], hardware=path_of(), **known)
    assert filters.which.tolist() == [0, 1, 0, 2, 3]
    assert len(filters.designs) == 4
    assert filters.rms_nm[0] == filters.rms_nm[2]


def test_a_failing_mode_is_named(monkeypatch):
    air = some_air(4)

    def failing(plant):
        if plant.turbulence[0].driving_rms_nm == air.driving_rms_nm[2]:
            raise lbt.errors.CertificateError("no good", failed=("distance",))
        return lbt.kalman(plant)

    monkeypatch.setattr(lbt_synth.design.modal.stack, "kalman", failing)
    with pytest.raises(lbt.errors.CertificateError, match="filter of mode 2: no good") as caught:
        modal_filters(air, hardware=path_of(), noise_nm=10.0)
    assert caught.value.failed == ("distance",)


def test_bad_filters_are_refused():
    air = some_air(3)

    def filters(noise_nm=1, **options):
        options = {"hardware": path_of(), "noise_nm": noise_nm} | options
        return lambda: modal_filters(air, **options)

    made = modal_filters([air.take(0)], hardware=path_of(), noise_nm=1.0)
    lines = "list of Vibration"
    require_refusals(
        [
            (filters(0.0), ProblemError, "noise_nm must be above 0"),
            (filters([1.0, 2.0]), DimensionError, "one per mode .3."),
            (filters(np.nan), NonFiniteError, "noise_nm"),
            (filters(hardware=3), ProblemError, "hardware must be a LoopHardware"),
            (filters(hardware=path_of(frame_rate_hz=400)), ProblemError, "loop's 400 Hz; got 800"),
            (filters(sensor_gain=-1), ProblemError, "sensor_gain must be above 0"),
            (filters(vibrations=[LINE]), ProblemError, "must be a mapping"),
            (filters(vibrations={3: LINE}), ProblemError, "must be at most 2; got 3"),
            (filters(vibrations={0: 3}), ProblemError, lines),
            (filters(vibrations={0: [1]}), ProblemError, lines),
            (lambda: made.design(1), ProblemError, "mode must be at most 0; got 1"),
        ]
    )


def controller_of(kind, n, delay):
    """Return a controller of n modes: integrators, filters, or some of both."""
    air, gains = some_air(n), np.linspace(0.1, 0.3, n)
    if kind == "integrators":
        return MixedController(gains=gains, leak=np.linspace(0.98, 1, n))
    if kind == "filters":
        path = path_of(delay_frames=delay)
        return modal_filters(air, hardware=path, noise_nm=8.0, vibrations={0: [LINE]})
    if kind == "mixed":
        return MixedController(filter=tip_tilt_filter(delay), gains=gains, filtered=(3, 1))
    two = modal_filters([air.take(0)] * 2, hardware=path_of(delay_frames=delay), noise_nm=8.0)
    return MixedController(filter=two, gains=gains, filtered=(2, 0))


@pytest.mark.parametrize(
    ("kind", "delay"), [("integrators", 2.7), ("filters", 1.4), ("mixed", 1), ("both", 3)]
)
def test_stepped_modes_are_the_linear_controller_of_all(kind, delay):
    n, frames = 5, 900  # some filters alone grow by 1.04 a frame
    controller = controller_of(kind, n, delay)
    rng = np.random.default_rng(4)
    total, noise = 100 * rng.standard_normal((frames, n)), 8 * rng.standard_normal((frames, n))
    gain = np.linspace(0.6, 1.1, n)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain))
    running = controller
    if kind == "filters":
        running = MixedController(filter=controller, gains=np.zeros(n), filtered=range(n))
    stepped = recorded_run(running, path, total, noise)
    linear = recorded_run(joint_controller(controller, n), path, total, noise)
    assert np.allclose(stepped, linear, atol=1e-10 * np.abs(linear).max())


@pytest.mark.parametrize(
    ("kind", "frame_means"),
    [("integrators", True), ("filters", False), ("mixed", True), ("both", False)],
)
def test_exact_residuals_are_those_of_the_budget(kind, frame_means):
    n, delay = 5, 2.4
    controller = controller_of(kind, n, delay)
    air, noise, gain = some_air(n, 2), np.linspace(1, 9, n), np.linspace(0.6, 1.1, n)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain))
    known = {"noise_nm": noise, "vibrations": {2: [HUM], 3: [LINE, HUM]}, "hardware": path}
    residuals = modal_residuals(controller, air, sensor_gain=gain, frame_means=frame_means, **known)
    closed = lbt.close_loop(path, joint_controller(controller, n))

    def along(i, line):
        held = 1 if frame_means else np.sinc(line.frequency_hz / RATE)
        return replace(line, rms_nm=line.rms_nm / held, direction=np.eye(n)[i])

    truth = lbt.Truth(
        turbulence=[air.take(i) for i in range(n)],
        vibrations=[along(2, HUM), along(3, LINE), along(3, HUM)],
        noise_nm=0.0,
    )
    variance = np.diag(lbt.residual_budget(closed, truth, frame_means=frame_means).total_nm2).copy()
    for i in range(n):
        B = closed.system.B[:, n + i : n + i + 1] * noise[i]
        D = closed.system.D[:, n + i : n + i + 1] * noise[i]
        P = solve_discrete_lyapunov(closed.system.A, B @ B.T)
        C = closed.system.C
        powers = np.diag(C @ P @ C.T + D @ D.T)
        # a command holds for one frame, and passes with its whole power
        variance += powers[:n] if frame_means else powers[n : 2 * n]
    assert np.allclose(residuals, np.sqrt(variance), rtol=1e-8)


def test_bad_loops_are_refused():
    known = {"noise_nm": 1.0}

    def residuals(gains, modes, **options):
        return lambda: integrator_residuals(gains, some_air(modes), **known, **options)

    def of(control, hardware):
        return lambda: modal_residuals(control, some_air(1), hardware=hardware, **known)

    two = modal_filters(some_air(2), hardware=path_of(), noise_nm=1.0)
    narrow = {"filter": two, "gains": [0.1, 0.1], "filtered": (0,)}
    slow, odd = ARModel(coefficients=[0.9], driving_rms_nm=5, frame_rate_hz=400), "got 400 Hz"
    require_refusals(
        [
            (residuals([0.5, 0.5, 1.2], 3), UnstableLoopError, "mode 2"),
            (residuals([0.5, 1.1, 1.2], 3), UnstableLoopError, "modes 1 and 2"),
            (residuals([0.5, 0.5, 0.5], 2), DimensionError, "must have 3 modes; got 2"),
            (of([0.5], path_of()), ProblemError, "MixedController or ModalFilters"),
            (of(two, 2.0), ProblemError, "hardware must be a LoopHardware"),
            (of(two, path_of(frame_rate_hz=400)), ProblemError, "rate of the filters, 800 Hz"),
            (lambda: integrator_residuals([0.1], [slow], **known), ProblemError, odd),
            (lambda: MixedController(**narrow), DimensionError, "the 1 filtered modes; got 2"),
        ]
    )
    assert residuals([0.5, 0.5, 1.2], 3, sensor_gain=0.5)().size == 3


def test_a_process_that_is_all_but_a_walk_leaves_what_a_walk_leaves():
    """The residual under a random walk is AR2, ``e(k+1) = e(k) - g e(k-1) + v + g n``."""
    g, v, n = 0.5, 10.0, 5.0
    walk = np.sqrt((1 + g) / ((1 - g) * ((1 + g) ** 2 - 1)) * (v**2 + g**2 * n**2))
    for distance in (1e-7, 1e-12, 1e-15):
        air = ARModel(
            coefficients=[[0.9], [1 - distance]], driving_rms_nm=[1.0, v], frame_rate_hz=RATE
        )
        known = {"hardware": path_of(), "frame_means": True}
        residual = modal_residuals(MixedController(gains=[g, g]), air, noise_nm=n, **known)[1]
        assert residual == pytest.approx(walk, rel=1e-7)
