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
    single_plant,
    some_air,
    tip_tilt_filter,
)
from support.recorded_runs import recorded_run
from support.refusals import require_refusals

import lbt_synth as lbt
import lbt_synth.design.modal.stack
from lbt_synth.design.modal import MixedController, modal_filters, modal_residuals, reconstructor
from lbt_synth.design.modal.stack import joining_check
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
    lines, known = {1: [LINE, HUM], 2: HUM}, {"delay_frames": delay, "mirror": shell}
    filters = modal_filters(air, noise_nm=noise, vibrations=lines, sensor_gain=gain, **known)
    path = filters.hardware
    assert (path.mirror, path.frame_rate_hz, path.delay_frames) == (shell, RATE, delay)
    exact = modal_residuals(filters, air, noise_nm=noise, vibrations=lines, sensor_gain=gain)
    assert np.allclose(exact, filters.rms_nm, rtol=1e-9)
    for i, mode_lines in enumerate(([], [LINE, HUM], [HUM])):
        one = lbt.kalman(single_plant(air, i, mode_lines, noise[i], gain[i], **known))
        mine = filters.design(i)
        assert np.array_equal(mine.gain_predictor, one.gain_predictor)
        for name in "ABCD":
            assert np.array_equal(getattr(mine.controller, name), getattr(one.controller, name))
        assert filters.certificate.rms_per_output[i] == one.rms
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
    filters = modal_filters([slow, fast, slow, slow, slow], **known)
    assert filters.which.tolist() == [0, 1, 0, 2, 3]
    assert len(filters.designs) == 4
    assert filters.rms_nm[0] == filters.rms_nm[2]


def test_a_failing_mode_is_named(monkeypatch):
    air = some_air(4)
    filters = modal_filters(air, noise_nm=10.0)
    off = filters.rms_nm * np.array([1.0, 1.0, 1.001, 1.0])
    check = joining_check(off, filters.rms_nm)
    assert not check.passed
    assert check.name.endswith("(mode 2)")
    assert "modes 0, 1, 2 and 3" in joining_check(2 * off, filters.rms_nm).name
    assert not joining_check(np.full(4, np.nan), filters.rms_nm).passed

    def failing(plant):
        if plant.turbulence[0].driving_rms_nm == air.driving_rms_nm[2]:
            raise lbt.errors.CertificateError("no good", failed=("distance",))
        return lbt.kalman(plant)

    monkeypatch.setattr(lbt_synth.design.modal.stack, "kalman", failing)
    with pytest.raises(lbt.errors.CertificateError, match="filter of mode 2: no good") as caught:
        modal_filters(air, noise_nm=10.0)
    assert caught.value.failed == ("distance",)


def test_bad_filters_are_refused():
    air = some_air(3)

    def filters(noise_nm=1, **options):
        return lambda: modal_filters(air, noise_nm=noise_nm, **options)

    made = modal_filters([air.take(0)], noise_nm=1.0)
    lines = "list of Vibration"
    require_refusals(
        [
            (filters(0.0), ProblemError, "noise_nm must be above 0"),
            (filters([1.0, 2.0]), DimensionError, "one per mode .3."),
            (filters(np.nan), NonFiniteError, "noise_nm"),
            (filters(delay_frames=0.5), ProblemError, "delay_frames"),
            (filters(sensor_gain=-1), ProblemError, "sensor_gain must be above 0"),
            (filters(vibrations=[LINE]), ProblemError, "must be a mapping"),
            (filters(vibrations={3: LINE}), ProblemError, "must be at most 2; got 3"),
            (filters(vibrations={0: 3}), ProblemError, lines),
            (filters(vibrations={0: [1]}), ProblemError, lines),
            (filters(mirror=3), ProblemError, "PositionLoop"),
            (lambda: made.design(1), ProblemError, "mode must be at most 0; got 1"),
            (lambda: made.start().step([1.0, 2.0]), DimensionError, r"\(1,\)"),
            (lambda: made.start().step(["a"]), ProblemError, "y must be an array of numbers"),
        ]
    )


def controller_of(kind, n, delay):
    """Return a controller of n modes: integrators, filters, or some of both."""
    air, gains = some_air(n), np.linspace(0.1, 0.3, n)
    if kind == "integrators":
        return MixedController(gains=gains, leak=np.linspace(0.98, 1, n))
    if kind == "filters":
        return modal_filters(air, noise_nm=8.0, vibrations={0: [LINE]}, delay_frames=delay)
    if kind == "mixed":
        return MixedController(filter=tip_tilt_filter(delay), gains=gains, filtered=(3, 1))
    two = modal_filters([air.take(0)] * 2, noise_nm=8.0, delay_frames=delay)
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
    running = controller.start() if kind == "filters" else controller
    stepped = recorded_run(running, path, total, noise)
    linear = recorded_run(running.as_controller(1 / RATE), path, total, noise)
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
    running = controller.start() if kind == "filters" else controller
    closed = lbt.close_loop(path, running.as_controller(1 / RATE))

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

    def of(control, **options):
        return lambda: modal_residuals(control, some_air(1), **known, **options)

    one = MixedController(gains=[0.5])
    bent = MixedController(gains=[0.5], reconstructor=reconstructor([[2.0]]))
    two = modal_filters(some_air(2), noise_nm=1.0)
    narrow = {"filter": two, "gains": [0.1, 0.1], "filtered": (0,)}
    require_refusals(
        [
            (residuals([0.5, 0.5, 1.2], 3), UnstableLoopError, "mode 2"),
            (residuals([0.5, 1.1, 1.2], 3), UnstableLoopError, "modes 1 and 2"),
            (residuals([0.5, 0.5, 0.5], 2), DimensionError, "must have 3 modes; got 2"),
            (of([0.5]), ProblemError, "MixedController or ModalFilters"),
            (of(bent), ProblemError, "reconstructor"),
            (of(one), ProblemError, "hardware must be given"),
            (of(one, hardware=2.0), ProblemError, "hardware must be a LoopHardware"),
            (lambda: MixedController(**narrow), DimensionError, "the 1 filtered modes; got 2"),
        ]
    )
    assert residuals([0.5, 0.5, 1.2], 3, sensor_gain=0.5)().size == 3


def test_loops_have_the_rate_of_their_filters():
    air = some_air(2)
    slow = ARModel(coefficients=[0.9], driving_rms_nm=5, frame_rate_hz=400)
    filters = modal_filters(air, noise_nm=10.0, delay_frames=3)
    mixed = MixedController(filter=filters, gains=[0.0, 0.0])
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=air.take(0), noise_nm=10.0, delay_frames=3
    )
    both = MixedController(filter=lbt.kalman(plant), gains=[0.0, 0.0, 0.2])
    slower, odd = lbt.LoopHardware(frame_rate_hz=400), "loop's 800 Hz; got 400 Hz"
    for controller in (filters, mixed, both):
        n = controller.n_modes
        wide, other = [air.take(0)] * n, [slow] * n

        def residuals(air=wide, controller=controller, **options):
            return modal_residuals(controller, air, noise_nm=10.0, **options)

        for delay in (3.0, 2.8):
            path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay)
            assert np.allclose(residuals(), residuals(hardware=path)) is (delay == 3.0)
        rows = [
            (lambda r=residuals, a=other: r(a), ProblemError, odd),
            (lambda r=residuals: r(hardware=slower), ProblemError, "rate of the filters, 800 Hz"),
        ]
        if controller is not filters:
            assert controller.as_controller().dt_s == 1 / RATE
            late = lambda c=controller: c.as_controller(1 / 400)  # noqa: E731
            rows.append((late, ProblemError, "dt_s must be that of the filter"))
        require_refusals(rows)
    assert np.allclose(modal_residuals(mixed, air, noise_nm=10.0), filters.rms_nm, rtol=1e-9)
    with pytest.raises(ProblemError, match=odd):
        integrator_residuals([0.1, 0.1], [slow] * 2, noise_nm=1.0)


def test_a_process_that_is_all_but_a_walk_leaves_what_a_walk_leaves():
    """The residual under a random walk is AR2, ``e(k+1) = e(k) - g e(k-1) + v + g n``."""
    g, v, n = 0.5, 10.0, 5.0
    walk = np.sqrt((1 + g) / ((1 - g) * ((1 + g) ** 2 - 1)) * (v**2 + g**2 * n**2))
    for distance in (1e-7, 1e-12, 1e-15):
        air = ARModel(
            coefficients=[[0.9], [1 - distance]], driving_rms_nm=[1.0, v], frame_rate_hz=RATE
        )
        known = {"hardware": lbt.LoopHardware(frame_rate_hz=RATE), "frame_means": True}
        residual = modal_residuals(MixedController(gains=[g, g]), air, noise_nm=n, **known)[1]
        assert residual == pytest.approx(walk, rel=1e-7)
