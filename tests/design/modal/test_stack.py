"""A stack of one-mode designs: each is that of kalman, and the loops of all leave what one does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from support.modal import HUM, LINE, RATE, integrator_residuals, single_plant, some_air
from support.plants import lbt_axis_plant
from support.recorded_runs import recorded_run

import lbt_synth as lbt
import lbt_synth.design.modal.stack
from lbt_synth.design.modal import MixedController, modal_filters, modal_residuals
from lbt_synth.design.modal.stack import joining_check


def lines_of(lines, mode):
    """Vibrations of a mode as a list."""
    some = lines.get(mode, [])
    return [some] if isinstance(some, lbt.Vibration) else some


@pytest.mark.parametrize(
    ("delay", "order", "bandwidth"),
    [
        *((delay, order, None) for delay in (1, 1.3, 2, 2.6, 3, 4.5) for order in (1, 2)),
        *((delay, 1, bandwidth) for delay in (1, 2, 2.6) for bandwidth in (60.0, 500.0)),
    ],
)
def test_each_filter_is_that_of_kalman(delay, order, bandwidth):
    n, shell = 6, None
    if bandwidth is not None:
        shell = lbt.models.PositionLoop.from_bandwidth(
            natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth
        )
    air = some_air(n, order)
    noise, gain = np.linspace(5, 30, n), np.linspace(0.5, 1.1, n)
    lines, known = {1: [LINE], 4: [LINE, HUM], 5: HUM}, {"delay_frames": delay, "mirror": shell}
    filters = modal_filters(air, noise_nm=noise, vibrations=lines, sensor_gain=gain, **known)
    path = filters.hardware
    assert (path.mirror, path.frame_rate_hz, path.delay_frames) == (shell, RATE, delay)
    exact = modal_residuals(filters, air, noise_nm=noise, vibrations=lines, sensor_gain=gain)
    assert np.allclose(exact, filters.rms_nm, rtol=1e-9)
    for i in range(n):
        own = lines_of(lines, i)
        one = lbt.kalman(single_plant(air, i, own, noise[i], gain[i], **known))
        mine = filters.design(i)
        assert np.array_equal(mine.gain_predictor, one.gain_predictor)
        for name in "ABCD":
            assert np.array_equal(getattr(mine.controller, name), getattr(one.controller, name))
        assert filters.certificate.rms_per_output[i] == one.rms
        moving = [
            replace(line, rms_nm=line.rms_nm / np.sinc(line.frequency_hz / RATE)) for line in own
        ]
        truth = lbt.Truth(turbulence=air.model(i), vibrations=moving, noise_nm=noise[i])
        path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[gain[i]]], **known)
        loop = lbt.close_loop(path, one.controller)
        budget = lbt.residual_budget(loop, truth)
        assert filters.rms_nm[i] == pytest.approx(budget.rms_nm, rel=1e-8)


def test_equal_modes_share_a_design():
    air = some_air(2)
    slow, fast = air.model(0), air.model(1)
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
    for arguments, error, words in (
        ({"noise_nm": 0.0}, lbt.errors.ProblemError, "noise_nm must be above 0"),
        ({"noise_nm": [1.0, 2.0]}, lbt.errors.DimensionError, "one per mode .3."),
        ({"noise_nm": np.nan}, lbt.errors.NonFiniteError, "noise_nm"),
        ({"noise_nm": 1, "delay_frames": 0.5}, lbt.errors.ProblemError, "delay_frames"),
        (
            {"noise_nm": 1, "sensor_gain": -1},
            lbt.errors.ProblemError,
            "sensor_gain must be above 0",
        ),
        ({"noise_nm": 1, "vibrations": [LINE]}, lbt.errors.ProblemError, "must be a mapping"),
        (
            {"noise_nm": 1, "vibrations": {3: LINE}},
            lbt.errors.ProblemError,
            "must be at most 2; got 3",
        ),
        ({"noise_nm": 1, "vibrations": {0: 3}}, lbt.errors.ProblemError, "list of Vibration"),
        ({"noise_nm": 1, "mirror": 3}, lbt.errors.ProblemError, "PositionLoop"),
        ({"noise_nm": 1, "vibrations": {0: [1]}}, lbt.errors.ProblemError, "list of Vibration"),
    ):
        with pytest.raises(error, match=words):
            modal_filters(air, **arguments)
    filters = modal_filters([air.model(0)], noise_nm=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="mode must be at most 0; got 1"):
        filters.design(1)
    with pytest.raises(lbt.errors.DimensionError, match=r"\(1,\)"):
        filters.start().step([1.0, 2.0])
    with pytest.raises(lbt.errors.ProblemError, match="y must be an array of numbers"):
        filters.start().step(["a"])


def test_filters_run_in_simulate():
    air = some_air(3)
    filters = modal_filters(air, noise_nm=8.0)
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=3)
    truth = lbt.Truth(turbulence=air.model(0), noise_nm=8.0)
    run = lbt.simulate(filters.start(), truth, hardware=path, frames=300)
    # the same residual but for the frames before, whose total phase is not kept
    assert run.residual_nm.shape == (1, 300, 3)
    exact = modal_residuals(filters, [air.model(0)] * 3, noise_nm=8.0)
    assert run.rms_nm[0] == pytest.approx(np.linalg.norm(exact), rel=0.25)


def controllers(n, delay):
    air = some_air(n)
    filters = modal_filters(air, noise_nm=8.0, vibrations={0: [LINE]}, delay_frames=delay)
    gains = np.linspace(0.1, 0.3, n)
    tip_tilt = lbt.kalman(lbt_axis_plant(modes=2, delay_frames=delay))
    return {
        "integrators": MixedController(gains=gains, leak=np.linspace(0.98, 1, n)),
        "filters": filters,
        "mixed": MixedController(filter=tip_tilt, gains=gains, filtered=(3, 1)),
        "both": MixedController(
            filter=modal_filters([air.model(0)] * 2, noise_nm=8.0, delay_frames=delay),
            gains=gains,
            filtered=(2, 0),
        ),
    }


@pytest.mark.parametrize("delay", [1, 1.4, 2, 2.7, 3])
@pytest.mark.parametrize("kind", ["integrators", "filters", "mixed", "both"])
def test_stepped_modes_are_the_linear_controller_of_all(kind, delay):
    n, frames = 5, 900  # some filters alone grow by 1.04 a frame
    controller = controllers(n, delay)[kind]
    rng = np.random.default_rng(4)
    total, noise = 100 * rng.standard_normal((frames, n)), 8 * rng.standard_normal((frames, n))
    gain = np.linspace(0.6, 1.1, n)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain))
    running = controller.start() if kind == "filters" else controller
    stepped = recorded_run(running, path, total, noise)
    whole = recorded_run(running.as_controller(1 / RATE), path, total, noise)
    assert np.allclose(stepped, whole, atol=1e-10 * np.abs(whole).max())


@pytest.mark.parametrize("frame_means", [True, False])
@pytest.mark.parametrize("kind", ["integrators", "filters", "mixed", "both"])
def test_exact_residuals_are_those_of_the_budget(kind, frame_means):
    n, delay = 5, 2.4
    controller = controllers(n, delay)[kind]
    air, noise, gain = some_air(n, 2), np.linspace(1, 9, n), np.linspace(0.6, 1.1, n)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain))
    got = modal_residuals(
        controller,
        air,
        noise_nm=noise,
        vibrations={2: [HUM], 3: [LINE, HUM]},
        hardware=path,
        sensor_gain=gain,
        frame_means=frame_means,
    )
    running = controller.start() if kind == "filters" else controller
    closed = lbt.close_loop(path, running.as_controller(1 / RATE))
    lines = [(2, HUM), (3, LINE), (3, HUM)]
    moving = [
        (
            i,
            line
            if frame_means
            else replace(line, rms_nm=line.rms_nm / np.sinc(line.frequency_hz / RATE)),
        )
        for i, line in lines
    ]
    truth = lbt.Truth(
        turbulence=[air.model(i) for i in range(n)],
        vibrations=[replace(line, direction=np.eye(n)[i]) for i, line in moving],
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
    assert np.allclose(got, np.sqrt(variance), rtol=1e-8)


def test_bad_loops_are_refused():
    known = {"noise_nm": 1.0}
    with pytest.raises(lbt.errors.UnstableLoopError, match="mode 2"):
        integrator_residuals([0.5, 0.5, 1.2], some_air(3), **known)
    with pytest.raises(lbt.errors.UnstableLoopError, match="modes 1 and 2"):
        integrator_residuals([0.5, 1.1, 1.2], some_air(3), **known)
    assert integrator_residuals([0.5, 0.5, 1.2], some_air(3), sensor_gain=0.5, **known).size == 3
    with pytest.raises(lbt.errors.DimensionError, match="must have 3 modes; got 2"):
        integrator_residuals([0.5, 0.5, 0.5], some_air(2), **known)
    bent = MixedController(gains=[0.5], reconstructor=lbt.design.modal.reconstructor([[2.0]]))
    for control, words in (([0.5], "MixedController or ModalFilters"), (bent, "reconstructor")):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            modal_residuals(control, some_air(1), **known)
    one = MixedController(gains=[0.5])
    with pytest.raises(lbt.errors.ProblemError, match="hardware must be given"):
        modal_residuals(one, some_air(1), **known)
    with pytest.raises(lbt.errors.ProblemError, match="hardware must be a LoopHardware"):
        modal_residuals(one, some_air(1), hardware=2.0, **known)
    two = modal_filters(some_air(2), noise_nm=1.0)
    with pytest.raises(lbt.errors.DimensionError, match="for the 1 filtered modes; got 2"):
        MixedController(filter=two, gains=[0.1, 0.1], filtered=(0,))


def test_loops_have_the_rate_of_their_filters():
    air, slow = (
        some_air(2),
        lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=5, frame_rate_hz=400),
    )
    filters = modal_filters(air, noise_nm=10.0, delay_frames=3)
    mixed = MixedController(filter=filters, gains=[0.0, 0.0])
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=air.model(0), noise_nm=10.0, delay_frames=3
    )
    both = MixedController(filter=lbt.kalman(plant), gains=[0.0, 0.0, 0.2])
    for controller in (filters, mixed, both):
        n = controller.n_modes
        wide = lbt.models.ModalTurbulence.of([air.model(0)] * n)
        own = modal_residuals(controller, wide, noise_nm=10.0)
        for delay in (3.0, 2.8):
            path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay)
            there = modal_residuals(controller, wide, noise_nm=10.0, hardware=path)
            assert np.allclose(own, there) is (delay == 3.0)
        with pytest.raises(lbt.errors.ProblemError, match="loop's 800 Hz; got 400 Hz"):
            modal_residuals(controller, [slow] * n, noise_nm=10.0)
        slower = lbt.LoopHardware(frame_rate_hz=400)
        with pytest.raises(lbt.errors.ProblemError, match="frame rate of the filters, 800 Hz"):
            modal_residuals(controller, wide, noise_nm=10.0, hardware=slower)
        if controller is not filters:
            assert controller.as_controller().dt_s == 1 / RATE
            assert controller.as_controller(1 / RATE).dt_s == 1 / RATE
            with pytest.raises(lbt.errors.ProblemError, match="dt_s must be that of the filter"):
                controller.as_controller(1 / 400)
    left = modal_residuals(mixed, air, noise_nm=10.0)
    assert np.allclose(left, filters.rms_nm, rtol=1e-9)
    with pytest.raises(lbt.errors.ProblemError, match="loop's 800 Hz; got 400 Hz"):
        integrator_residuals([0.1, 0.1], [slow] * 2, noise_nm=1.0)


def test_a_process_that_is_all_but_a_walk_leaves_what_a_walk_leaves():
    def residual(distance):
        air = lbt.models.ModalTurbulence(
            coefficients=[[0.9], [1 - distance]], driving_rms_nm=[1.0, 10.0], frame_rate_hz=RATE
        )
        control = MixedController(gains=[0.5, 0.5])
        path = lbt.LoopHardware(frame_rate_hz=RATE)
        return modal_residuals(control, air, noise_nm=5.0, hardware=path, frame_means=True)[1]

    # under a random walk the residual is AR2, e(k+1) = e(k) - g e(k-1) + v + g n
    g, v, n = 0.5, 10.0, 5.0
    walk = np.sqrt((1 + g) / ((1 - g) * ((1 + g) ** 2 - 1)) * (v**2 + g**2 * n**2))
    for distance in (1e-7, 1e-9, 1e-12, 1e-15):
        assert residual(distance) == pytest.approx(walk, rel=1e-7)
