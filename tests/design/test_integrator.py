from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from support.predictions import SHELL, a_plant, truth_of_all_moments
from support.uneven_axes import LOOPS, QUICK, RATE, SLOW

import lbt_synth as lbt


@pytest.mark.parametrize(("delay", "limit"), [(1, 2.0), (2, 1.0), (3, 0.618034), (4, 0.445042)])
def test_limits_of_whole_delays(delay, limit):
    assert lbt.design.integrator_gain_limit(delay) == pytest.approx(limit, abs=1e-6)


@given(delay=st.floats(1, 4.5))
def test_the_limit_is_where_the_loop_turns_unstable(delay):
    limit = lbt.design.integrator_gain_limit(delay)
    path = lbt.LoopHardware(frame_rate_hz=1, delay_frames=delay, modes=1)

    def radius(gain):
        controller = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0)
        return lbt.close_loop(path, controller).spectral_radius

    assert radius(limit * (1 - 1e-4)) < 1
    assert radius(limit * (1 + 1e-4)) > 1


def test_a_gain_beyond_the_limit_does_not_leave_the_library():
    path = lbt.LoopHardware(frame_rate_hz=800)
    with pytest.raises(lbt.errors.CertificateError, match="spectral radius of the closed loop"):
        lbt.integrator(path, gain=1.01)
    with pytest.raises(lbt.errors.CertificateError):  # marginal
        lbt.integrator(path, gain=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="gain must be above 0"):
        lbt.integrator(path, gain=0.0)


def test_the_best_gain_beats_a_fine_search(air):
    path = lbt.LoopHardware(frame_rate_hz=800)
    truth = lbt.Truth(turbulence=air, noise_nm=15.5, sensor_gain=0.6)
    best = lbt.design.optimal_integrator(path, truth)

    def residual(gain):
        controller = lbt.integrator(path, gain=gain).controller
        return lbt.residual_budget(lbt.close_loop(path, controller, sensor_gain=0.6), truth).rms_nm

    least = min(residual(g) for g in np.linspace(0.02, 0.98, 97))
    assert residual(best.gain) <= least * (1 + 1e-6)


def test_reconstructor_inverts_any_sensor():
    rng = np.random.default_rng(0)
    path = lbt.LoopHardware(
        frame_rate_hz=800,
        sensor_matrix=rng.standard_normal((5, 2)),
        influence_matrix=rng.standard_normal((2, 2)),
    )
    design = lbt.integrator(path, gain=0.4)
    plain = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4)
    f = [0.5, 10, 100]
    one = lbt.close_loop(path, design.controller).sensitivity(f)
    other = lbt.close_loop(plain.hardware, plain.controller).sensitivity(f)
    assert np.allclose(one, other, atol=1e-12)


def test_an_undisturbed_loop_has_no_best_gain():
    with pytest.raises(lbt.errors.ProblemError, match="must disturb the loop"):
        lbt.design.optimal_integrator(
            lbt.LoopHardware(frame_rate_hz=800), lbt.Truth(turbulence=None)
        )


@pytest.mark.parametrize(("delay", "mirror"), [(2.0, None), (2.49, None), (2.25, SHELL)])
def test_the_integrator_of_a_plant_is_that_of_its_truth(delay, mirror):
    plant = a_plant(delay=delay, mirror=mirror)
    own, other = (
        lbt.design.model_integrator(plant),
        lbt.design.optimal_integrator(plant.hardware, truth_of_all_moments()),
    )
    assert own.gain == pytest.approx(other.gain, rel=1e-5)
    assert own.certificate.passed


@pytest.mark.parametrize("delay", [2.0, 2.49])
def test_the_integrator_of_a_plant_leaves_the_least_of_its_budget(delay):
    lines = [
        lbt.Vibration(frequency_hz=f, damping=0.02, rms_nm=60.0, direction=way)
        for f, way in ((12.0, (1.0, 0.0)), (31.0, (0.6, 0.8)))
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=[SLOW, QUICK],
        vibrations=lines,
        noise_nm=[[225.0, 80.0], [80.0, 400.0]],
        sensor_matrix=[[0.8, 0.3], [-0.1, 0.6]],
        delay_frames=delay,
    )

    def left(gain: float) -> float:
        design = lbt.integrator(plant.hardware, gain=gain)
        loop = lbt.close_loop(plant.hardware, design.controller)
        return lbt.residual_budget(loop, plant).rms_nm

    gain = lbt.design.model_integrator(plant).gain
    best = minimize_scalar(left, bounds=(0.5 * gain, 1.5 * gain), options={"xatol": 1e-7})
    assert gain == pytest.approx(best.x, rel=1e-4)
    assert left(gain) <= best.fun * (1 + 1e-12)


def test_truths_of_other_loops_are_refused():
    both, single = LOOPS
    two = lbt.Truth(turbulence=[SLOW, QUICK], noise_nm=5.0)
    noisy = lbt.Truth(turbulence=SLOW, noise_nm=[5.0, 5.0])
    design = lbt.integrator(single, gain=0.4)
    loop = lbt.close_loop(single, design.controller)
    for act in (
        lambda truth: lbt.residual_budget(loop, truth),
        lambda truth: lbt.loop.least_residual(single, truth),
        lambda truth: lbt.simulate(design.controller, truth, hardware=single, frames=9, seed=0),
        lambda truth: lbt.design.optimal_integrator(single, truth),
    ):
        with pytest.raises(lbt.errors.DimensionError, match=r"one per mode \(1\); got 2"):
            act(two)
        with pytest.raises(lbt.errors.DimensionError, match=r"one per measurement \(1\); got 2"):
            act(noisy)
    for wrong in ({"noise_nm": [1.0]}, {"noise_nm": 1.0, "sensor_gain": [1.0]}):
        with pytest.raises(lbt.errors.DimensionError, match="measurement"):
            lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=SLOW, **wrong)
    with pytest.raises(lbt.errors.ProblemError, match="the truth must disturb the loop"):
        lbt.design.optimal_integrator(both, lbt.Truth(turbulence=[None, None], noise_nm=[0, 0]))


def test_the_least_of_two_minima():
    """A line above the bandwidth: hardly any loop, or a fast one that takes turbulence with it."""
    path = lbt.LoopHardware(frame_rate_hz=500, delay_frames=3, modes=1)
    line = lbt.models.SinusoidalVibration(frequency_hz=28.5, rms_nm=38.76, direction=(1,))
    truth = lbt.Truth(
        turbulence=lbt.models.ARModel(
            coefficients=[0.9926], driving_rms_nm=2.27, frame_rate_hz=500
        ),
        noise_nm=6.94,
        vibrations=(line,),
    )

    def residual(gain: float) -> float:
        controller = lbt.integrator(path, gain=gain).controller
        return lbt.residual_budget(lbt.close_loop(path, controller), truth).rms_nm

    found = residual(lbt.design.optimal_integrator(path, truth).gain)
    assert residual(0.0117) < min(residual(0.005), residual(0.03))  # the other minimum
    assert found <= min(map(residual, np.linspace(0.005, 0.615, 123)))


def test_where_no_loop_is_best_the_status_says_so():
    """White noise alone: each gain adds to it, the least that is tried adds least."""
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    idle = lbt.design.optimal_integrator(path, lbt.Truth(turbulence=None, noise_nm=20.0))
    assert idle.solver.status.startswith("limited by the least gain tried")
    assert idle.gain == pytest.approx(1e-4, rel=1e-3)
