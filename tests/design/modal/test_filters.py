"""A Kalman filter for every mode, against that of one."""

import numpy as np
import pytest
from support.modal import HUM, LINE, RATE, single_plant, some_air

import lbt_synth as lbt
from lbt_synth.design.modal.banks import LoopBlock, LoopVariances
from lbt_synth.design.modal.filters import batch_errors, modal_certificate
from lbt_synth.design.modal.plants import ModalModels


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
    shell = lbt.models.PositionLoop.from_bandwidth(
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


def test_a_failing_mode_is_named():
    air = some_air(4)
    filters = lbt.design.modal.modal_filters(air, noise_nm=10.0)
    models = ModalModels.of(air, filters.noise_nm, None)
    (batch,) = models.plants(2.0, filters.sensor_gain)
    solution = lbt.solve_dare(
        np.swapaxes(batch.A, 1, 2), np.swapaxes(batch.C, 1, 2), batch.Q, batch.R
    )
    gains = np.array(filters.gain_predictor)[..., None]
    gains[2] *= 1.001
    zero, one = np.zeros(4), np.ones((4, 1, 1))
    block = LoopBlock(batch.modes[:, None], 0.5 * one, one, one, one)
    loops = block, LoopVariances(filters.rms_nm[:, None] ** 2, zero, zero)

    def certificate():
        errors, variances = batch_errors(batch, gains, solution, loops, applied=False)
        return modal_certificate(errors, variances, applied=False)

    checks = certificate()
    assert not checks.passed
    with pytest.raises(lbt.errors.CertificateError, match="least-variance gain .mode 2."):
        checks.require()
    gains[:] = 5.0
    with pytest.raises(lbt.errors.CertificateError, match="modes 0, 1, 2 and 3"):
        certificate().require()


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
            lbt.design.modal.modal_filters(air, **arguments)
    filters = lbt.design.modal.modal_filters([air.model(0)], noise_nm=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="mode must be at most 0; got 1"):
        filters.controller(1)
    with pytest.raises(lbt.errors.DimensionError, match=r"\(1,\)"):
        filters.start().step([1.0, 2.0])
    with pytest.raises(lbt.errors.ProblemError, match="y must be an array of numbers"):
        filters.start().step(["a"])


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
