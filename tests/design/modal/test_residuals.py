"""What loops of many modes leave, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from support.modal import HUM, LINE, RATE, integrator_residuals, some_air
from support.plants import lbt_axis_plant
from support.recorded_runs import recorded_run

import lbt_synth as lbt
from lbt_synth.design.modal import MixedController, modal_filters, modal_residuals


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
