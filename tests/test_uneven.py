"""Axes that differ: a spectrum, a noise and a sensor gain for each of them."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lbt_synth as lbt
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual

RATE = 800.0
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=60.0, frame_rate_hz=RATE)
QUICK = lbt.models.ARModel(coefficients=[1.6, -0.65], driving_rms_nm=25.0, frame_rate_hz=RATE)
TABLE = lbt.models.TabulatedSpectrum(frequency_hz=[1, 20, 120], density_nm2_hz=[900, 400, 3])
LINES = (
    lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=(1, 0)),
    lbt.models.SinusoidalVibration(frequency_hz=33, rms_nm=90, direction=(0, 1)),
)
uneven = partial(lbt.Truth, noise_nm=(15.5, 6.0), sensor_gain=0.8)


def one_axis(truth, axis):
    """The same truth on one axis."""
    lines = []
    for line in truth.vibrations:
        if line.direction[axis]:
            extra = {"damping": line.damping} if isinstance(line, lbt.Vibration) else {}
            lines.append(
                type(line)(
                    frequency_hz=line.frequency_hz, rms_nm=line.rms_nm, direction=(1,), **extra
                )
            )
    return lbt.Truth(
        turbulence=truth.turbulence[axis],
        vibrations=lines,
        noise_nm=truth.noise_nm[axis],
        sensor_gain=truth.sensor_gain,
    )


@pytest.fixture(scope="module")
def loops():
    both = lbt.LoopHardware(frame_rate_hz=RATE)
    single = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    return both, single


@pytest.mark.parametrize("spectra", [(SLOW, QUICK), (SLOW, TABLE), (None, QUICK), (TABLE, None)])
def test_axes_without_coupling_are_loops_of_their_own(loops, spectra):
    both, single = loops
    truth = uneven(turbulence=spectra, vibrations=LINES)
    budget = lbt.residual_budget(
        lbt.close_loop(both, lbt.integrator(both, gain=0.4).controller, sensor_gain=0.8), truth
    )
    limit = lbt.loop.least_residual(both, truth)
    for axis in (0, 1):
        loop = lbt.close_loop(single, lbt.integrator(single, gain=0.4).controller, sensor_gain=0.8)
        alone = one_axis(truth, axis)
        own = lbt.residual_budget(loop, alone)
        for name in ("turbulence_nm2", "noise_nm2", "vibration_nm2"):
            assert getattr(budget, name)[axis, axis] == pytest.approx(
                getattr(own, name)[0, 0], rel=1e-9
            ), name
        assert limit.variance_nm2[axis] == pytest.approx(
            lbt.loop.least_residual(single, alone).variance_nm2[0], rel=1e-9
        )
    assert abs(budget.turbulence_nm2[0, 1]) < 1e-9


@settings(max_examples=25, deadline=None)
@given(st.floats(0.1, 50), st.sampled_from([SLOW, QUICK, TABLE, None]))
def test_equal_axes_are_one_truth_for_all(noise, spectrum):
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3).controller)
    one = lbt.residual_budget(loop, lbt.Truth(turbulence=spectrum, noise_nm=noise))
    each = lbt.residual_budget(loop, lbt.Truth(turbulence=[spectrum] * 2, noise_nm=[noise] * 2))
    np.testing.assert_allclose(each.total_nm2, one.total_nm2, rtol=1e-12, atol=1e-12)


def test_coupled_axes_against_the_frequency_response():
    """A loop that mixes the axes: the sum of |S e_i|^2 S_i by brute force."""
    path = lbt.LoopHardware(
        frame_rate_hz=RATE, sensor_matrix=[[1.0, 0.2], [-0.1, 0.7]], influence_matrix=np.eye(2)
    )
    controller = lbt.integrator(lbt.LoopHardware(frame_rate_hz=RATE), gain=0.3).controller
    loop = lbt.close_loop(path, controller)
    truth = lbt.Truth(turbulence=[SLOW, TABLE], noise_nm=[3.0, 9.0])
    f = (np.arange(400_000) + 0.5) * RATE / 2 / 400_000
    S, N = loop.sensitivity(f), loop.noise_transfer(f)
    density = np.stack([SLOW.psd(f), TABLE.psd(f)], axis=-1)
    white = np.array([3.0, 9.0]) ** 2 / (RATE / 2)
    want = np.einsum("fij,fj,fkj->ik", S, density, S.conj()).real * (f[1] - f[0])
    noise = np.einsum("fij,j,fkj->ik", N, white, N.conj()).real * (f[1] - f[0])
    budget = lbt.residual_budget(loop, truth)
    np.testing.assert_allclose(budget.turbulence_nm2, want, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(budget.noise_nm2, noise, rtol=1e-5, atol=1e-4)


def test_a_simulation_agrees_with_the_exact_answer(loops):
    both, _ = loops
    truth = lbt.Truth(turbulence=[SLOW, TABLE], noise_nm=[20.0, 5.0], vibrations=LINES)
    design = lbt.integrator(both, gain=0.4)
    run = lbt.simulate(design.controller, truth, hardware=both, frames=20_000, cases=4, seed=3)
    exact = lbt.residual_budget(lbt.close_loop(both, design.controller), truth)
    power = np.mean(run.residual_nm**2, axis=(0, 1))
    np.testing.assert_allclose(power, np.diag(exact.total_nm2), rtol=0.05)


def test_a_mode_keeps_its_weather_when_the_other_changes(loops):
    both, _ = loops
    design = lbt.integrator(both, gain=0.4)
    runs = [
        lbt.simulate(
            design.controller,
            lbt.Truth(turbulence=[SLOW, other]),
            hardware=both,
            frames=50,
            cases=2,
            seed=1,
        )
        for other in (QUICK, TABLE, None)
    ]
    for run in runs[1:]:
        np.testing.assert_array_equal(run.residual_nm[..., 0], runs[0].residual_nm[..., 0])
        assert not np.array_equal(run.residual_nm[..., 1], runs[0].residual_nm[..., 1])
    assert not np.any(runs[2].residual_nm[..., 1])


def test_the_map_is_the_budget_at_each_point(loops):
    both, _ = loops
    truth = lbt.Truth(turbulence=[SLOW, TABLE], noise_nm=[15.5, 6.0], vibrations=LINES)
    design = lbt.integrator(both, gain=0.4)
    camera = lbt.Imaging(diameter_m=8.22)
    found = lbt.studies.robustness_map(
        design, truth, camera, errors_hz=[0], sensor_gains=[0.6, 1.0]
    )
    for i, gain in enumerate([0.6, 1.0]):
        loop = lbt.close_loop(both, design.controller, sensor_gain=gain)
        real = lbt.Truth(
            turbulence=truth.turbulence, noise_nm=truth.noise_nm, vibrations=LINES, sensor_gain=gain
        )
        budget = lbt.residual_budget(loop, real)
        assert found.residual_nm[0, i, 0] == pytest.approx(budget.rms_nm, rel=1e-8)
        assert found.strehl[0, i, 0] == pytest.approx(lbt.strehl(budget, camera), rel=1e-8)


def test_equal_models_may_be_turned_into_each_other(loops):
    """Two models of the same numbers are one turbulence: a vibration across them decouples."""
    both, _ = loops
    again = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=60.0, frame_rate_hz=RATE)
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=(1, 1))
    one = lbt.loop.least_residual(both, lbt.Truth(turbulence=SLOW, vibrations=[line], noise_nm=5))
    two = lbt.loop.least_residual(
        both, lbt.Truth(turbulence=[SLOW, again], vibrations=[line], noise_nm=5)
    )
    assert two.rms_nm == pytest.approx(one.rms_nm, rel=1e-12)
    with pytest.raises(lbt.errors.ProblemError, match="a limit needs modes that decouple"):
        lbt.loop.least_residual(
            both, lbt.Truth(turbulence=[SLOW, QUICK], vibrations=[line], noise_nm=5)
        )


def test_the_plant_of_uneven_axes_is_two_plants():
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=[SLOW, QUICK], noise_nm=[15.5, 6.0], sensor_gain=[0.9, 0.7]
    )
    np.testing.assert_array_equal(plant.hardware.sensor, np.diag([0.9, 0.7]))
    np.testing.assert_allclose(plant.R, np.diag([15.5, 6.0]) ** 2, rtol=1e-14)
    both = lbt.kalman(plant)
    alone = [
        lbt.kalman(
            lbt.tip_tilt_plant(
                frame_rate_hz=RATE, turbulence=model, noise_nm=noise, sensor_gain=gain, modes=1
            )
        ).rms
        for model, noise, gain in ((SLOW, 15.5, 0.9), (QUICK, 6.0, 0.7))
    ]
    assert both.rms == pytest.approx(np.hypot(*alone), rel=1e-9)
    limit = least_model_residual(plant)
    np.testing.assert_allclose(np.sqrt(limit.variance_nm2), alone, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"turbulence": []}, lbt.errors.DimensionError, "got an empty sequence"),
        ({"turbulence": [SLOW, 3.0]}, lbt.errors.ProblemError, "one a mode; got float"),
        ({"turbulence": "slow"}, lbt.errors.ProblemError, "one a mode; got str"),
        (
            {"turbulence": None, "noise_nm": [[1.0]]},
            lbt.errors.DimensionError,
            r"got shape \(1, 1\)",
        ),
        ({"turbulence": None, "noise_nm": []}, lbt.errors.DimensionError, r"got shape \(0,\)"),
        ({"turbulence": None, "noise_nm": [1.0, -1.0]}, lbt.errors.ProblemError, "noise_nm"),
        ({"turbulence": None, "noise_nm": [1.0, np.nan]}, lbt.errors.ProblemError, "noise_nm"),
    ],
)
def test_wrong_truths_are_refused(arguments, error, text):
    with pytest.raises(error, match=text):
        lbt.Truth(**arguments)


def test_truths_of_other_loops_are_refused(loops):
    both, single = loops
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
        with pytest.raises(lbt.errors.DimensionError, match=r"one a mode \(1\); got 2"):
            act(two)
        with pytest.raises(lbt.errors.DimensionError, match=r"one a measurement \(1\); got 2"):
            act(noisy)
    for wrong in ({"noise_nm": [1.0]}, {"noise_nm": 1.0, "sensor_gain": [1.0]}):
        with pytest.raises(lbt.errors.DimensionError, match="measurement"):
            lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=SLOW, **wrong)
    with pytest.raises(lbt.errors.ProblemError, match="the truth must disturb the loop"):
        lbt.design.optimal_integrator(both, lbt.Truth(turbulence=[None, None], noise_nm=[0, 0]))
