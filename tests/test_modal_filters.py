"""A Kalman filter for every mode, and the loop of all modes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design.modal import certificate as certificates
from lbt_synth.design.modal.plants import lines_per_mode, plant_stacks
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.loop.budget import ar_covariance
from lbt_synth.loop.simulation.block_filtering import BatchedSystems
from lbt_synth.loop.simulation.run import step_loop

RATE = 800.0
LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
HUM = lbt.Vibration(frequency_hz=55, damping=0.02, rms_nm=40.0, direction=(1,))


def some_air(n: int, order: int = 1, seed: int = 0) -> lbt.models.ModalTurbulence:
    rng = np.random.default_rng(seed)
    if order == 1:
        coefficients = rng.uniform(0.9, 0.995, (n, 1))
    else:
        decay, turn = rng.uniform(0.9, 0.99, n), rng.uniform(0.005, 0.1, n)
        coefficients = np.stack([2 * decay * np.cos(turn), -(decay**2)], axis=1)
    return lbt.models.ModalTurbulence(
        coefficients=coefficients, driving_rms_nm=10 ** rng.uniform(0, 2, n), frame_rate_hz=RATE
    )


def single_plant(air, mode, lines, noise, gain, delay):
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=air.model(mode),
        vibrations=list(lines) or None,
        noise_nm=float(noise),
        delay_frames=delay,
        sensor_gain=float(gain),
        modes=1,
    )


# ---------------------------------------------------------------- turbulence as arrays
def test_arrays_are_the_single_models():
    models = [
        lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=3.0, frame_rate_hz=RATE),
        lbt.models.ARModel(coefficients=[1.9, -0.92], driving_rms_nm=1.0, frame_rate_hz=RATE),
    ]
    air = lbt.models.ModalTurbulence.of(models)
    assert (air.n_modes, air.order) == (2, 2)
    assert np.allclose(air.rms_nm, [m.rms_nm for m in models], rtol=1e-13)
    f = np.geomspace(0.1, 400, 7)
    assert np.allclose(air.psd(f), [m.psd(f) for m in models], rtol=1e-12)
    assert air.model(1).coefficients.tolist() == [1.9, -0.92]


def test_bad_arrays_are_refused():
    ok = {"coefficients": [[0.9], [0.8]], "driving_rms_nm": [1, 1], "frame_rate_hz": 800}
    for change, error, words in (
        ({"coefficients": [[0.9], [1.0]]}, lbt.errors.ProblemError, "modulus 1 in mode 1"),
        ({"coefficients": np.zeros((0, 1))}, lbt.errors.DimensionError, "at least one of each"),
        ({"driving_rms_nm": [1]}, lbt.errors.DimensionError, r"shape \(2,\)"),
        ({"driving_rms_nm": [1, 0]}, lbt.errors.ProblemError, "above 0"),
        ({"frame_rate_hz": 0}, lbt.errors.ProblemError, "frame_rate_hz"),
    ):
        with pytest.raises(error, match=words):
            lbt.models.ModalTurbulence(**(ok | change))
    air = lbt.models.ModalTurbulence(**ok)
    with pytest.raises(lbt.errors.ProblemError, match="from 0 to 1"):
        air.model(2)
    with pytest.raises(lbt.errors.ProblemError, match="one ARModel a mode"):
        lbt.models.ModalTurbulence.of([])
    slow = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=1.0, frame_rate_hz=500)
    with pytest.raises(lbt.errors.ProblemError, match="same frame rate"):
        lbt.models.ModalTurbulence.of([air.model(0), slow])


# ---------------------------------------------------------------- filters
@pytest.mark.parametrize("delay", [1, 1.3, 2, 2.6, 3, 4.5])
@pytest.mark.parametrize("order", [1, 2])
def test_each_filter_is_that_of_kalman(delay, order):
    n = 6
    air = some_air(n, order)
    noise, gain = np.linspace(5, 30, n), np.linspace(0.5, 1.1, n)
    lines = {1: [LINE], 4: [LINE, HUM], 5: HUM}
    filters = lbt.design.modal.modal_filters(
        air, noise_nm=noise, vibrations=lines, delay_frames=delay, sensor_gain=gain
    )
    for i in range(n):
        own = lines.get(i, [])
        own = [own] if isinstance(own, lbt.Vibration) else own
        plant = single_plant(air, i, own, noise[i], gain[i], delay)
        one = lbt.kalman(plant)
        s, c = filters.states[i], filters.controller_states[i]
        assert s == plant.n_states
        assert np.allclose(
            filters.gain_predictor[i, :s], one.gain_predictor[:, 0], rtol=1e-10, atol=1e-10
        )
        assert not filters.gain_predictor[i, s:].any()
        mine = filters.controller(i)
        for name in "ABCD":
            assert np.allclose(getattr(mine, name), getattr(one.controller, name), atol=1e-10)
        assert c == one.controller.n_states
        assert filters.certificate.rms_per_output[i] == pytest.approx(one.rms, rel=1e-10)
        # multiple poles at 0 have few digits, their polynomial has them all
        assert np.allclose(np.poly(filters.poles[i, :s]), np.poly(one.poles), atol=1e-9)
        truth = lbt.Truth(turbulence=air.model(i), vibrations=tuple(own), noise_nm=noise[i])
        path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=[[gain[i]]])
        exact = lbt.residual_budget(lbt.close_loop(path, one.controller), truth)
        assert filters.rms_nm[i] == pytest.approx(exact.rms_nm, rel=1e-8)


@pytest.mark.parametrize("delay", [1, 2, 2.6])
@pytest.mark.parametrize("bandwidth", [60.0, 500.0])
def test_filters_know_the_mirror_as_kalman_does(delay, bandwidth):
    shell = lbt.models.PositionLoop.of_bandwidth(
        natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth
    )
    air, lines = some_air(4), {1: [LINE], 3: [LINE, HUM]}
    noise, gain = np.linspace(5, 20, 4), np.linspace(0.6, 1.1, 4)
    known = {"delay_frames": delay, "mirror": shell}
    filters = lbt.design.modal.modal_filters(
        air, noise_nm=noise, vibrations=lines, sensor_gain=gain, **known
    )
    loop = lbt.design.modal.modal_loop(filters, sensor_gain=gain)
    assert (loop.mirror, loop.frame_rate_hz, loop.delay_frames) == (shell, RATE, delay)
    exact = loop.residual_rms_nm(air, noise_nm=noise, vibrations=lines)
    assert np.allclose(exact, filters.rms_nm, rtol=1e-9)
    for i in range(4):
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=RATE,
            turbulence=air.model(i),
            vibrations=lines.get(i),
            noise_nm=float(noise[i]),
            sensor_gain=float(gain[i]),
            modes=1,
            **known,
        )
        one = lbt.kalman(plant)
        mine = filters.controller(i)
        assert mine.n_states == one.controller.n_states
        for name in "ABCD":
            assert np.allclose(getattr(mine, name), getattr(one.controller, name), atol=1e-10)
        truth = lbt.Truth(
            turbulence=air.model(i), vibrations=tuple(lines.get(i, ())), noise_nm=noise[i]
        )
        path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[gain[i]]], **known)
        budget = lbt.residual_budget(lbt.close_loop(path, one.controller), truth)
        assert filters.rms_nm[i] == pytest.approx(budget.rms_nm, rel=1e-8)


@pytest.mark.parametrize("delay", [1, 2.6, 3])
def test_stacked_plants_are_tip_tilt_plants(delay):
    air, lines = some_air(3), lines_per_mode({2: [LINE, HUM]}, 3)
    stacks = plant_stacks(
        air, lines, noise_nm=np.full(3, 7.0), delay_frames=delay, sensor_gain=np.full(3, 0.8)
    )
    for stack in stacks:
        for j, mode in enumerate(stack.modes):
            plant = single_plant(air, mode, lines[mode], 7.0, 0.8, delay)
            for name in ("A", "Q", "C", "L", "R"):
                assert np.allclose(getattr(stack, name)[j], getattr(plant, name), rtol=1e-12)


def test_a_failing_mode_is_named():
    air = some_air(4)
    filters = lbt.design.modal.modal_filters(air, noise_nm=10.0)
    (stack,) = plant_stacks(
        air,
        filters.vibrations,
        noise_nm=filters.noise_nm,
        delay_frames=2.0,
        sensor_gain=filters.sensor_gain,
    )
    solution = lbt.solve_dare(
        np.swapaxes(stack.A, 1, 2), np.swapaxes(stack.C, 1, 2), stack.Q, stack.R
    )
    gains = np.array(filters.gain_predictor)[..., None]
    gains[2] *= 1.001
    examined = certificates.Examined(4)
    examined.filters(stack, gains, solution)
    zero = np.zeros(4)
    examined.loops(stack.modes, np.full(4, 0.5), filters.rms_nm[:, None] ** 2, zero, zero)
    checks = examined.certificate(applied=False)
    assert not checks.passed
    with pytest.raises(lbt.errors.CertificateError, match="least-variance gain .mode 2."):
        checks.require()
    gains[:] = 5.0
    examined.filters(stack, gains, solution)
    with pytest.raises(lbt.errors.CertificateError, match="modes 0, 1, 2 and 3"):
        examined.certificate(applied=False).require()


def test_stacked_lyapunov_is_scipys():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((20, 4, 4))
    A *= (rng.uniform(0.1, 0.9999, 20) / np.abs(np.linalg.eigvals(A)).max(axis=1))[:, None, None]
    B = rng.standard_normal((20, 4, 2))
    Q = B @ np.swapaxes(B, 1, 2)
    X, residuals = stationary_covariances(A, Q)
    assert np.all(residuals < 1e-13)
    for a, q, x in zip(A, Q, X, strict=True):
        assert np.allclose(x, solve_discrete_lyapunov(a, q), rtol=1e-7)
    unstable, _ = stationary_covariances(1.01 * np.eye(2)[None], np.eye(2)[None])
    assert not np.isfinite(unstable).any()


def test_bad_filters_are_refused():
    air = some_air(3)
    for arguments, error, words in (
        ({"noise_nm": 0.0}, lbt.errors.ProblemError, "noise_nm must be above 0"),
        ({"noise_nm": [1.0, 2.0]}, lbt.errors.DimensionError, "one a mode .3."),
        ({"noise_nm": np.nan}, lbt.errors.NonFiniteError, "noise_nm"),
        ({"noise_nm": 1, "delay_frames": 0.5}, lbt.errors.ProblemError, "delay_frames"),
        (
            {"noise_nm": 1, "sensor_gain": -1},
            lbt.errors.ProblemError,
            "sensor_gain must be above 0",
        ),
        ({"noise_nm": 1, "vibrations": [LINE]}, lbt.errors.ProblemError, "must be a mapping"),
        ({"noise_nm": 1, "vibrations": {3: LINE}}, lbt.errors.ProblemError, "from 0 to 2"),
        ({"noise_nm": 1, "vibrations": {0: 3}}, lbt.errors.ProblemError, "list of Vibration"),
        ({"noise_nm": 1, "mirror": 3}, lbt.errors.ProblemError, "PositionLoop"),
        ({"noise_nm": 1, "vibrations": {0: [1]}}, lbt.errors.ProblemError, "list of Vibration"),
    ):
        with pytest.raises(error, match=words):
            lbt.design.modal.modal_filters(air, **arguments)
    filters = lbt.design.modal.modal_filters([air.model(0)], noise_nm=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="from 0 to 0"):
        filters.controller(1)
    with pytest.raises(lbt.errors.DimensionError, match=r"\(1,\)"):
        filters.start().step([1.0, 2.0])
    with pytest.raises(lbt.errors.ProblemError, match="y must be an array of numbers"):
        filters.start().step(["a"])


# ---------------------------------------------------------------- the loop of all modes
@given(
    count=st.integers(1, 4),
    n=st.integers(1, 5),
    m=st.integers(1, 2),
    p=st.integers(1, 3),
    frames=st.integers(1, 200),
    seed=st.integers(0, 100),
)
def test_stacked_series_are_the_recursion(count, n, m, p, frames, seed):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((count, n, n))
    A *= (0.999 / np.abs(np.linalg.eigvals(A)).max(axis=1))[:, None, None]
    B, C = rng.standard_normal((count, n, m)), rng.standard_normal((count, p, n))
    D, u = rng.standard_normal((count, p, m)), rng.standard_normal((count, frames, m))
    out = BatchedSystems(A, B, C, D).filter(u)
    for i in range(count):
        system = lbt.linear.StateSpace(A=A[i], B=B[i], C=C[i], D=D[i])
        expected = lbt.loop.filter_series(system, u[i])
        assert np.allclose(out[i], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    if m == p:
        again = u.copy()
        assert BatchedSystems(A, B, C, D).filter(again, in_place=True) is again
        assert np.array_equal(again, out)


def controllers(n, delay):
    air = some_air(n)
    filters = lbt.design.modal.modal_filters(
        air, noise_nm=8.0, vibrations={0: [LINE]}, delay_frames=delay
    )
    gains = np.linspace(0.1, 0.3, n)
    tip_tilt = lbt.kalman(lbt_axis_plant(modes=2, delay_frames=delay))
    return {
        "integrators": lbt.design.modal.MixedController.integrators(
            gains, leak=np.linspace(0.98, 1, n)
        ),
        "filters": filters,
        "mixed": lbt.design.modal.MixedController(filter=tip_tilt, gains=gains, filtered=(3, 1)),
        "both": lbt.design.modal.MixedController(
            filter=lbt.design.modal.modal_filters(
                [air.model(0)] * 2, noise_nm=8.0, delay_frames=delay
            ),
            gains=gains,
            filtered=(2, 0),
        ),
    }


@pytest.mark.parametrize("delay", [1, 1.4, 2, 2.7, 3])
@pytest.mark.parametrize("kind", ["integrators", "filters", "mixed", "both"])
def test_series_are_those_of_the_loop_as_written(kind, delay):
    n, frames = 5, 150
    controller = controllers(n, delay)[kind]
    rng = np.random.default_rng(4)
    total, noise = 100 * rng.standard_normal((n, frames)), 8 * rng.standard_normal((n, frames))
    gain = np.linspace(0.6, 1.1, n)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain))
    running = (
        controller.start() if isinstance(controller, lbt.design.modal.ModalFilters) else controller
    )
    expected = step_loop(running, 1.0, path, total.T[None], noise.T[None])[0].T
    loop = lbt.design.modal.modal_loop(controller, delay_frames=delay, sensor_gain=gain)
    run = loop.run(total, noise, all_series=True)
    got = np.concatenate([run.residual_nm, run.commands, run.measurements])
    assert np.allclose(got, expected, atol=1e-10 * np.abs(expected).max())
    brief = loop.run(total, noise, settle_frames=50)
    assert brief.commands is None
    assert brief.measurements is None
    assert np.allclose(brief.residual_nm, expected[:n, 50:], atol=1e-9)
    assert np.allclose(brief.rms_nm, np.sqrt(np.mean(expected[:n, 50:] ** 2, axis=1)))


@pytest.mark.parametrize("kind", ["integrators", "filters", "mixed", "both"])
def test_exact_residuals_are_those_of_the_budget(kind):
    n, delay = 5, 2.4
    controller = controllers(n, delay)[kind]
    air, noise, gain = some_air(n, 2), np.linspace(1, 9, n), np.linspace(0.6, 1.1, n)
    loop = lbt.design.modal.modal_loop(controller, delay_frames=delay, sensor_gain=gain)
    got = loop.residual_rms_nm(air, noise_nm=noise, vibrations={2: [HUM], 3: [LINE, HUM]})
    whole = (
        lbt.design.modal.MixedController(filter=controller, gains=np.zeros(n), filtered=range(n))
        if kind == "filters"
        else controller
    ).as_controller(1 / RATE)
    # one mode of the disturbances at a time, in the loop of all modes
    variance = np.zeros(n)
    for i in range(n):
        unit = tuple(np.eye(n)[i])
        closed = lbt.close_loop(
            lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain)),
            whole,
        )
        variance += np.diag(ar_covariance(closed, air.model(i), np.eye(n)[i : i + 1]))
        own = {2: (HUM,), 3: (LINE, HUM)}.get(i, ())
        for line in own:
            variance += np.diag(ar_covariance(closed, line.ar_model(RATE), np.array([unit])))
        B = closed.system.B[:, n + i : n + i + 1] * noise[i]
        D = closed.system.D[:n, n + i : n + i + 1] * noise[i]
        P = solve_discrete_lyapunov(closed.system.A, B @ B.T)
        C = closed.system.C[:n]
        variance += np.diag(C @ P @ C.T + D @ D.T)
    assert np.allclose(got, np.sqrt(variance), rtol=1e-8)


def test_filters_run_in_simulate():
    air = some_air(3)
    filters = lbt.design.modal.modal_filters(air, noise_nm=8.0)
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=3)
    truth = lbt.Truth(turbulence=air.model(0), noise_nm=8.0)
    run = lbt.simulate(filters.start(), truth, hardware=path, frames=300)
    again = lbt.design.modal.modal_loop(filters)
    # the same residual but for the frames before, whose total phase is not kept
    assert run.residual_nm.shape == (1, 300, 3)
    exact = again.residual_rms_nm([air.model(0)] * 3, noise_nm=8.0)
    assert run.rms_nm[0] == pytest.approx(np.linalg.norm(exact), rel=0.25)


def test_bad_loops_are_refused():
    classical = lbt.design.modal.MixedController.integrators([0.5, 0.5, 1.2])
    loop = lbt.design.modal.modal_loop(classical)
    series = np.zeros((3, 10))
    with pytest.raises(lbt.errors.UnstableLoopError, match="mode 2"):
        loop.run(series, series)
    with pytest.raises(lbt.errors.UnstableLoopError, match="mode 2"):
        loop.residual_rms_nm(some_air(3), noise_nm=1.0)
    calm = lbt.design.modal.modal_loop(classical, sensor_gain=0.5)
    assert calm.is_stable
    with pytest.raises(lbt.errors.DimensionError, match=r"must both be \(3, frames\)"):
        calm.run(series[:2], series)
    with pytest.raises(lbt.errors.ProblemError, match="more frames than settle_frames"):
        calm.run(series, series, settle_frames=10)
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
        lbt.design.modal.modal_loop([0.5])
    with pytest.raises(lbt.errors.ProblemError, match="reconstructor"):
        lbt.design.modal.modal_loop(
            lbt.design.modal.MixedController.integrators(
                [0.5], reconstructor=lbt.design.modal.reconstructor([[2.0]])
            )
        )
    two = lbt.design.modal.modal_filters(some_air(2), noise_nm=1.0)
    with pytest.raises(lbt.errors.DimensionError, match="for the 1 filtered modes; got 2"):
        lbt.design.modal.MixedController(filter=two, gains=[0.1, 0.1], filtered=(0,))


# ---------------------------------------------------------------- rates, delays, digits
def test_loops_have_the_rate_of_their_filters():
    air, slow = (
        some_air(2),
        lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=5, frame_rate_hz=400),
    )
    filters = lbt.design.modal.modal_filters(air, noise_nm=10.0, delay_frames=3)
    mixed = lbt.design.modal.MixedController(filter=filters, gains=[0.0, 0.0])
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=air.model(0), noise_nm=10.0, delay_frames=3
    )
    both = lbt.design.modal.MixedController(filter=lbt.kalman(plant), gains=[0.0, 0.0, 0.2])
    for controller in (filters, mixed, both):
        loop = lbt.design.modal.modal_loop(controller)
        assert (loop.delay_frames, loop.frame_rate_hz, loop.is_stable) == (3.0, RATE, True)
        assert lbt.design.modal.modal_loop(controller, delay_frames=2.8).delay_frames == 2.8
        n = controller.n_modes
        with pytest.raises(lbt.errors.ProblemError, match="loop's frame rate, 800 Hz; got 400 Hz"):
            loop.residual_rms_nm([slow] * n, noise_nm=10.0)
        with pytest.raises(
            lbt.errors.ProblemError, match="frame_rate_hz must be that of the filters"
        ):
            lbt.design.modal.modal_loop(controller, frame_rate_hz=400)
        if controller is not filters:
            assert controller.as_controller().dt_s == 1 / RATE
            assert controller.as_controller(1 / RATE).dt_s == 1 / RATE
            with pytest.raises(lbt.errors.ProblemError, match="dt_s must be that of the filter"):
                controller.as_controller(1 / 400)
    assert np.allclose(
        lbt.design.modal.modal_loop(mixed).residual_rms_nm(air, noise_nm=10.0),
        filters.rms_nm,
        rtol=1e-9,
    )
    plain = lbt.design.modal.MixedController.integrators([0.1, 0.1])
    free = lbt.design.modal.modal_loop(plain)
    assert (free.frame_rate_hz, free.delay_frames) == (None, 2.0)
    assert free.residual_rms_nm([slow] * 2, noise_nm=1.0).shape == (2,)
    with pytest.raises(lbt.errors.ProblemError, match="loop's frame rate, 800 Hz"):
        lbt.design.modal.modal_loop(plain, frame_rate_hz=RATE).residual_rms_nm(
            [slow] * 2, noise_nm=1.0
        )
    shell = lbt.models.PositionLoop.of_bandwidth(
        natural_frequency_hz=20, damping=0.5, bandwidth_hz=300
    )
    with pytest.raises(lbt.errors.ProblemError, match="needs frame_rate_hz"):
        lbt.design.modal.modal_loop(plain, mirror=shell)


def test_a_process_that_is_all_but_a_walk_is_refused():
    loop = lbt.design.modal.modal_loop(lbt.design.modal.MixedController.integrators([0.5, 0.5]))

    def residual(distance):
        air = lbt.models.ModalTurbulence(
            coefficients=[[0.9], [1 - distance]], driving_rms_nm=[1.0, 10.0], frame_rate_hz=RATE
        )
        return loop.residual_rms_nm(air, noise_nm=5.0)[1]

    # under a random walk the residual is AR2, e(k+1) = e(k) - g e(k-1) + v + g n
    g, v, n = 0.5, 10.0, 5.0
    walk = np.sqrt((1 + g) / ((1 - g) * ((1 + g) ** 2 - 1)) * (v**2 + g**2 * n**2))
    for distance in (1e-7, 1e-8, 1e-9):
        assert residual(distance) == pytest.approx(walk, rel=1e-6)
    for distance in (1e-12, 1e-15):
        with pytest.raises(lbt.errors.NumericalError, match="rounding of the variance.*mode 1"):
            residual(distance)


def test_series_that_are_no_numbers_are_refused():
    loop = lbt.design.modal.modal_loop(lbt.design.modal.MixedController.integrators([0.5]))
    for total, noise in (("a", "b"), ([["1", "2"]], [[0, 0]]), ([[1j, 0]], [[0, 0]])):
        with pytest.raises(lbt.errors.ProblemError, match="total_nm must be"):
            loop.run(total, noise)
    with pytest.raises(lbt.errors.DimensionError, match="rows of unequal length"):
        loop.run([[1.0], [1.0, 2.0]], [[1.0]])
