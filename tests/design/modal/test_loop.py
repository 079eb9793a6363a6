"""Loops of many modes: exact residuals, series, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from support.modal import HUM, LINE, RATE, integrator_loop, some_air
from support.plants import lbt_axis_plant
from support.recorded_runs import recorded_run

import lbt_synth as lbt
from lbt_synth.design.modal import MixedController, modal_filters, modal_loop


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
def test_series_are_those_of_the_loop_as_written(kind, delay):
    n, frames = 5, 900  # some filters alone grow by 1.04 a frame
    controller = controllers(n, delay)[kind]
    rng = np.random.default_rng(4)
    total, noise = 100 * rng.standard_normal((n, frames)), 8 * rng.standard_normal((n, frames))
    gain = np.linspace(0.6, 1.1, n)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain))
    running = controller.start() if kind == "filters" else controller
    expected = recorded_run(running, path, total.T, noise.T)[0].T
    loop = modal_loop(controller, hardware=path, sensor_gain=gain)
    run = loop.run(total, noise, all_series=True)
    got = np.concatenate([run.residual_nm, run.commands, run.measurements])
    assert np.allclose(got, expected, atol=1e-10 * np.abs(expected).max())
    brief = loop.run(total, noise)
    assert brief.commands is None
    assert brief.measurements is None
    assert np.allclose(brief.residual_nm, expected[:n], atol=1e-9)
    assert np.allclose(brief.rms_nm, np.sqrt(np.mean(expected[:n] ** 2, axis=1)))


@pytest.mark.parametrize("kind", ["integrators", "filters", "mixed", "both"])
def test_exact_residuals_are_those_of_the_budget(kind):
    n, delay = 5, 2.4
    controller = controllers(n, delay)[kind]
    air, noise, gain = some_air(n, 2), np.linspace(1, 9, n), np.linspace(0.6, 1.1, n)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain))
    loop = modal_loop(controller, hardware=path, sensor_gain=gain)
    got = loop.residual_rms_nm(air, noise_nm=noise, vibrations={2: [HUM], 3: [LINE, HUM]})
    running = controller.start() if kind == "filters" else controller
    closed = lbt.close_loop(path, running.as_controller(1 / RATE))
    lines = [(2, HUM), (3, LINE), (3, HUM)]
    truth = lbt.Truth(
        turbulence=[air.model(i) for i in range(n)],
        vibrations=[replace(line, direction=np.eye(n)[i]) for i, line in lines],
        noise_nm=0.0,
    )
    variance = np.diag(lbt.residual_budget(closed, truth, frame_means=True).total_nm2).copy()
    for i in range(n):
        B = closed.system.B[:, n + i : n + i + 1] * noise[i]
        D = closed.system.D[:n, n + i : n + i + 1] * noise[i]
        P = solve_discrete_lyapunov(closed.system.A, B @ B.T)
        C = closed.system.C[:n]
        variance += np.diag(C @ P @ C.T + D @ D.T)
    assert np.allclose(got, np.sqrt(variance), rtol=1e-8)


def test_bad_loops_are_refused():
    loop = integrator_loop([0.5, 0.5, 1.2])
    series = np.zeros((3, 10))
    with pytest.raises(lbt.errors.UnstableLoopError, match="mode 2"):
        loop.run(series, series)
    with pytest.raises(lbt.errors.UnstableLoopError, match="mode 2"):
        loop.residual_rms_nm(some_air(3), noise_nm=1.0)
    calm = integrator_loop([0.5, 0.5, 1.2], sensor_gain=0.5)
    assert calm.is_stable
    with pytest.raises(lbt.errors.DimensionError, match=r"must both be \(3, frames\)"):
        calm.run(series[:2], series)
    with pytest.raises(lbt.errors.DimensionError, match="at least one frame"):
        calm.run(series[:, :0], series[:, :0])
    for bad in (np.nan, np.inf):
        broken = series.copy()
        broken[1, 4] = bad
        with pytest.raises(lbt.errors.NonFiniteError, match="total_nm"):
            calm.run(broken, series)
        with pytest.raises(lbt.errors.NonFiniteError, match="noise_nm"):
            calm.run(series, broken)
        ending = series.copy()
        ending[1, -1] = bad
        with pytest.raises(lbt.errors.NonFiniteError, match="noise_nm"):
            calm.run(series, ending, all_series=True)
    with pytest.raises(lbt.errors.DimensionError, match="must have 3 modes; got 2"):
        calm.residual_rms_nm(some_air(2), noise_nm=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="MixedController or ModalFilters"):
        modal_loop([0.5])
    with pytest.raises(lbt.errors.ProblemError, match="reconstructor"):
        modal_loop(
            MixedController(gains=[0.5], reconstructor=lbt.design.modal.reconstructor([[2.0]]))
        )
    with pytest.raises(lbt.errors.ProblemError, match="hardware must be given"):
        modal_loop(MixedController(gains=[0.5]))
    with pytest.raises(lbt.errors.ProblemError, match="hardware must be a LoopHardware"):
        modal_loop(MixedController(gains=[0.5]), hardware=2.0)
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
    late = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=2.8)
    for controller in (filters, mixed, both):
        loop = modal_loop(controller)
        assert loop.is_stable
        assert (loop.hardware.delay_frames, loop.hardware.frame_rate_hz) == (3.0, RATE)
        assert modal_loop(controller, hardware=late).hardware.delay_frames == 2.8
        n = controller.n_modes
        with pytest.raises(lbt.errors.ProblemError, match="loop's 800 Hz; got 400 Hz"):
            loop.residual_rms_nm([slow] * n, noise_nm=10.0)
        with pytest.raises(lbt.errors.ProblemError, match="frame rate of the filters, 800 Hz"):
            modal_loop(controller, hardware=lbt.LoopHardware(frame_rate_hz=400))
        if controller is not filters:
            assert controller.as_controller().dt_s == 1 / RATE
            assert controller.as_controller(1 / RATE).dt_s == 1 / RATE
            with pytest.raises(lbt.errors.ProblemError, match="dt_s must be that of the filter"):
                controller.as_controller(1 / 400)
    left = modal_loop(mixed).residual_rms_nm(air, noise_nm=10.0)
    assert np.allclose(left, filters.rms_nm, rtol=1e-9)
    with pytest.raises(lbt.errors.ProblemError, match="loop's 800 Hz; got 400 Hz"):
        integrator_loop([0.1, 0.1]).residual_rms_nm([slow] * 2, noise_nm=1.0)


def test_a_process_that_is_all_but_a_walk_leaves_what_a_walk_leaves():
    loop = integrator_loop([0.5, 0.5])

    def residual(distance):
        air = lbt.models.ModalTurbulence(
            coefficients=[[0.9], [1 - distance]], driving_rms_nm=[1.0, 10.0], frame_rate_hz=RATE
        )
        return loop.residual_rms_nm(air, noise_nm=5.0)[1]

    # under a random walk the residual is AR2, e(k+1) = e(k) - g e(k-1) + v + g n
    g, v, n = 0.5, 10.0, 5.0
    walk = np.sqrt((1 + g) / ((1 - g) * ((1 + g) ** 2 - 1)) * (v**2 + g**2 * n**2))
    for distance in (1e-7, 1e-9, 1e-12, 1e-15):
        assert residual(distance) == pytest.approx(walk, rel=1e-7)


def test_series_that_are_no_numbers_are_refused():
    loop = integrator_loop([0.5])
    for total, noise in (("a", "b"), ([["1", "2"]], [[0, 0]]), ([[1j, 0]], [[0, 0]])):
        with pytest.raises(lbt.errors.ProblemError, match="total_nm must be"):
            loop.run(total, noise)
    with pytest.raises(lbt.errors.DimensionError, match="rows of unequal length"):
        loop.run([[1.0], [1.0, 2.0]], [[1.0]])
