"""Controllers made of filters of the pseudo-open-loop measurement."""

import numpy as np
import pytest
from support.lqg import shell

import lbt_synth as lbt


@pytest.mark.parametrize("delay", [1.0, 1.3, 2.0, 2.5, 3.0, 4.0])
@pytest.mark.parametrize("feedthrough", [False, True])
def test_the_closed_loop_is_affine_in_the_filter(delay, feedthrough):
    rng = np.random.default_rng(3)
    A = np.diag([0.9, 0.4, -0.5])
    sensor = np.array([[1.0, 0.2], [0.0, 0.8], [0.1, 0.1]])
    mirror = np.array([[1.0, 0.1], [-0.2, 0.9]])
    path = lbt.LoopHardware(
        frame_rate_hz=800, delay_frames=delay, sensor_matrix=sensor, influence_matrix=mirror
    )
    parameter = lbt.Controller(
        A=A,
        B=rng.normal(size=(3, 3)),
        C=rng.normal(size=(2, 3)),
        D=rng.normal(size=(2, 3)) if feedthrough else np.zeros((2, 3)),
        dt_s=1 / 800,
    )
    loop = lbt.close_loop(path, lbt.loop.youla_controller(path, parameter))
    assert loop.is_stable
    f = np.array([0.0, 3.0, 20.0, 150.0, 400.0])
    z = np.exp(2j * np.pi * f / 800)[:, None, None]
    Q = parameter.to_statespace().frequency_response(f)
    M = sum(tap * mirror * z**-i for i, tap in enumerate(path.mirror_taps))
    np.testing.assert_allclose(loop.sensitivity(f), np.eye(2) - M @ Q @ sensor / z, atol=1e-11)
    np.testing.assert_allclose(loop.noise_transfer(f), -M @ Q, atol=1e-11)


def test_a_filter_of_another_size_is_refused():
    path = lbt.LoopHardware(frame_rate_hz=800)
    with pytest.raises(
        lbt.errors.DimensionError, match="map 2 measurements to 2 commands; got 1 to 1"
    ):
        lbt.loop.youla_controller(path, lbt.Controller(A=0.0, B=1.0, C=1.0, D=0.0, dt_s=1 / 800))


@pytest.mark.parametrize("delay", [1.0, 1.4, 2.0, 2.5])
@pytest.mark.parametrize("feedthrough", [False, True])
def test_the_loop_with_a_moving_mirror_is_affine_in_the_filter(delay, feedthrough):
    rng = np.random.default_rng(3)
    influence = np.array([[1.0, 0.1], [-0.2, 0.9]])
    path = lbt.LoopHardware(
        frame_rate_hz=800,
        delay_frames=delay,
        influence_matrix=influence,
        mirror=shell(70, delay_samples=2),
    )
    parameter = lbt.Controller(
        A=np.diag([0.9, 0.4, -0.5]),
        B=rng.normal(size=(3, 2)),
        C=rng.normal(size=(2, 3)),
        D=rng.normal(size=(2, 2)) * feedthrough,
        dt_s=1 / 800,
    )
    loop = lbt.close_loop(path, lbt.loop.youla_controller(path, parameter))
    assert loop.is_stable
    f = np.array([0.0, 3.0, 20.0, 150.0, 400.0])
    z = np.exp(2j * np.pi * f / 800)[:, None, None]
    Q = parameter.to_statespace().frequency_response(f)
    M = sum(tap * influence * z**-i for i, tap in enumerate(path.mirror_taps))
    np.testing.assert_allclose(loop.sensitivity(f), np.eye(2) - M @ Q / z, atol=1e-10)
    np.testing.assert_allclose(loop.noise_transfer(f), -M @ Q, atol=1e-10)
