"""The exact residual of a loop against closed forms and brute force."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid
from support import predictions
from support.plants import lbt_axis_plant
from support.uneven_axes import LINES, LOOPS, QUICK, RATE, SLOW, TABLE, one_axis

import lbt_synth as lbt


class Anonymous:
    """A spectrum that hides that it is an AR model, so that it goes through quadrature."""

    def __init__(self, model):
        self.model = model

    def psd(self, frequency_hz):
        return self.model.psd(frequency_hz)


def test_noise_of_an_integrator_has_a_closed_form():
    """Delay 1: variance g / (2 - g); delay 2: g (from the Jury table) (2 + g) / ((2 - g ...)."""
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    for g in (0.1, 0.7, 1.6):
        loop = lbt.close_loop(path, lbt.integrator(path, gain=g).controller)
        budget = lbt.residual_budget(loop, lbt.Truth(turbulence=None, noise_nm=2.0))
        assert budget.noise_nm**2 == pytest.approx(4 * g / (2 - g), rel=1e-9)


@pytest.mark.parametrize("gain", [0.4, 1.0])
@pytest.mark.parametrize(
    "model",
    [
        lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89, frame_rate_hz=800),
        lbt.models.ARModel(
            coefficients=[1.997477, -0.997555], driving_rms_nm=0.37, frame_rate_hz=800
        ),
        lbt.Vibration(frequency_hz=17, damping=0.005, rms_nm=300).ar_model(800),
    ],
)
def test_quadrature_agrees_with_the_lyapunov_equation(gain, model):
    plant = lbt_axis_plant(modes=2)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller, sensor_gain=gain)
    exact, quadrature = (
        lbt.residual_budget(loop, lbt.Truth(turbulence=source, sensor_gain=gain)).turbulence_nm2
        for source in (model, Anonymous(model))
    )
    assert np.allclose(quadrature, exact, rtol=2e-4, atol=1e-9 * exact.max())


@pytest.mark.parametrize("half_width", [0.3, 0.03, 0.003])
def test_narrow_lines_of_a_table_are_not_missed(half_width):
    """A triangle of unit area: its residual is the rejection at its place."""
    table = lbt.models.TabulatedSpectrum(
        frequency_hz=[37.3 - half_width, 37.3, 37.3 + half_width],
        density_nm2_hz=[0, 100 / half_width, 0],
    )
    plant = lbt_axis_plant()
    loop = lbt.close_loop(plant.hardware, lbt.integrator(plant.hardware, gain=0.4).controller)
    budget = lbt.residual_budget(loop, lbt.Truth(turbulence=table))
    gain = abs(loop.sensitivity([37.3])[0, 0, 0])
    assert budget.turbulence_nm == pytest.approx(10 * gain, rel=1e-3)


def test_a_measured_spectrum_against_brute_force():
    rng = np.random.default_rng(0)
    f = np.linspace(5, 100, 3393)
    lines = sum(40 / (1 + ((f - c) / w) ** 2) for c, w in ((10, 0.1), (48.3, 0.03), (72.5, 0.05)))
    table = lbt.models.TabulatedSpectrum(
        frequency_hz=f, density_nm2_hz=lines * rng.uniform(0.2, 1, f.size)
    )
    plant = lbt_axis_plant()
    loop = lbt.close_loop(plant.hardware, lbt.integrator(plant.hardware, gain=0.4).controller)
    fine = np.linspace(5, 100, 3392 * 20 + 1)
    power = np.abs(loop.sensitivity(fine)[:, 0, 0]) ** 2
    expected = trapezoid(table.psd(fine) * power, fine)
    budget = lbt.residual_budget(loop, lbt.Truth(turbulence=table))
    assert budget.turbulence_nm**2 == pytest.approx(expected, rel=1e-5)


def test_a_narrow_resonance_tends_to_the_sinusoid():
    plant = lbt_axis_plant(modes=2)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    along = {"frequency_hz": 18.0, "rms_nm": 100.0, "direction": (0.6, 0.8)}
    line = lbt.Truth(turbulence=None, vibrations=(lbt.models.SinusoidalVibration(**along),))
    narrow = lbt.Truth(turbulence=None, vibrations=(lbt.Vibration(**along, damping=1e-6),))
    exact, limit = (lbt.residual_budget(loop, t).vibration_nm2 for t in (line, narrow))
    assert np.allclose(limit, exact, rtol=1e-3)


def test_parts_of_the_budget_add_up():
    plant = lbt_axis_plant(modes=2)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    truth = lbt.Truth(
        turbulence=plant.turbulence[0],
        noise_nm=15.5,
        vibrations=(
            lbt.models.SinusoidalVibration(frequency_hz=19, rms_nm=50),
            lbt.Vibration(frequency_hz=31, damping=0.01, rms_nm=20, direction=(0, 1)),
        ),
    )
    b = lbt.residual_budget(loop, truth)
    assert b.rms_nm**2 == pytest.approx(b.turbulence_nm**2 + b.vibration_nm**2 + b.noise_nm**2)
    assert np.allclose(b.total_nm2, b.turbulence_nm2 + b.vibration_nm2 + b.noise_nm2)


@given(angle=st.floats(0, np.pi))
def test_a_decoupled_loop_treats_all_directions_alike(angle):
    plant = lbt_axis_plant(modes=2)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    line = lbt.models.SinusoidalVibration(
        frequency_hz=18, rms_nm=100, direction=(np.cos(angle), np.sin(angle))
    )
    budget = lbt.residual_budget(loop, lbt.Truth(turbulence=None, vibrations=(line,)))
    other = lbt.models.SinusoidalVibration(frequency_hz=18, rms_nm=100)
    same = lbt.residual_budget(loop, lbt.Truth(turbulence=None, vibrations=(other,)))
    assert budget.rms_nm == pytest.approx(same.rms_nm, rel=1e-6)


def test_loops_refuse_what_does_not_fit():
    path = lbt.LoopHardware(frame_rate_hz=800)
    lazy = lbt.integrator(path, gain=0.3).controller
    with pytest.raises(
        lbt.errors.DimensionError, match="map 1 measurements to 1 commands; got 2 to 2"
    ):
        lbt.close_loop(lbt.LoopHardware(frame_rate_hz=800, modes=1), lazy)
    with pytest.raises(
        lbt.errors.ProblemError, match="must run at the loop's 500 Hz; got one designed for 800"
    ):
        lbt.close_loop(lbt.LoopHardware(frame_rate_hz=500), lazy)
    loop = lbt.close_loop(path, lazy)
    with pytest.raises(lbt.errors.ProblemError, match="truth's sensor gain 0.5; got 1"):
        lbt.residual_budget(loop, lbt.Truth(turbulence=None, sensor_gain=0.5))
    line = lbt.models.SinusoidalVibration(frequency_hz=10, rms_nm=1, direction=(1, 0, 0))
    with pytest.raises(lbt.errors.DimensionError, match="must have 2 components"):
        lbt.residual_budget(loop, lbt.Truth(turbulence=None, vibrations=(line,)))
    fast = lbt.models.SinusoidalVibration(frequency_hz=600, rms_nm=1)
    with pytest.raises(lbt.errors.ProblemError, match="below the Nyquist"):
        lbt.residual_budget(loop, lbt.Truth(turbulence=None, vibrations=(fast,)))
    other_rate = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=1, frame_rate_hz=100)
    with pytest.raises(lbt.errors.ProblemError, match="must be sampled at the loop's 800 Hz"):
        lbt.residual_budget(loop, lbt.Truth(turbulence=other_rate))


uneven = partial(lbt.Truth, noise_nm=(15.5, 6.0), sensor_gain=0.8)


@pytest.mark.parametrize("spectra", [(SLOW, QUICK), (SLOW, TABLE), (None, QUICK), (TABLE, None)])
def test_axes_without_coupling_are_loops_of_their_own(spectra):
    both, single = LOOPS
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


@pytest.mark.parametrize(("delay", "gain", "mirror", "sensor"), predictions.CASES)
def test_the_budget_of_a_model_is_that_of_its_truth(delay, gain, mirror, sensor):
    plant = predictions.a_plant(delay=delay, gain=gain, mirror=mirror, sensor=sensor)
    controller = lbt.integrator(plant.hardware, gain=0.2).controller
    loop = lbt.close_loop(plant.hardware, controller)
    own, other = (
        lbt.loop.model_budget(loop, plant),
        lbt.residual_budget(loop, predictions.a_truth()),
    )
    for name in ("turbulence_nm2", "noise_nm2", "random_vibration_nm2", "total_nm2"):
        np.testing.assert_allclose(getattr(own, name), getattr(other, name), rtol=1e-9, atol=1e-9)
    bare = predictions.a_plant(delay=delay, mirror=mirror, sensor=sensor).hardware
    again = lbt.loop.model_budget(lbt.close_loop(bare, controller, sensor_gain=gain), plant)
    np.testing.assert_allclose(again.total_nm2, own.total_nm2, rtol=1e-9, atol=1e-9)


def test_noise_that_is_correlated_between_axes():
    noise = np.array([[200.0, 60.0], [60.0, 100.0]])
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=predictions.RATE, turbulence=predictions.SLOW, noise_nm=noise
    )
    design = lbt.kalman(plant)
    budget = lbt.loop.model_budget(lbt.close_loop(plant.hardware, design.controller), plant)
    assert budget.rms_nm == pytest.approx(design.rms, rel=1e-9)


def test_a_budget_of_another_loop_is_refused():
    plant = predictions.a_plant()
    for other in (
        predictions.a_plant(delay=3.0),
        predictions.a_plant(gain=0.5),
        predictions.a_plant(mirror=predictions.SHELL),
    ):
        loop = lbt.close_loop(other.hardware, lbt.integrator(other.hardware, gain=0.1).controller)
        with pytest.raises(
            lbt.errors.ProblemError, match="plant's sensor, mirror and delay; got another"
        ):
            lbt.loop.model_budget(loop, plant)
    unstable = lbt.close_loop(
        plant.hardware, lbt.integrator(plant.hardware, gain=0.9).controller, sensor_gain=1.0
    )
    wild = lbt.Controller(
        A=np.eye(2), B=3 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=1 / predictions.RATE
    )
    assert unstable.is_stable
    with pytest.raises(lbt.errors.UnstableLoopError):
        lbt.loop.model_budget(lbt.close_loop(plant.hardware, wild), plant)
    with pytest.raises(lbt.errors.ProblemError, match="expected a TipTiltPlant"):
        lbt.loop.model_budget(unstable, predictions.a_truth())
    with pytest.raises(lbt.errors.ProblemError, match="expected a ClosedLoop"):
        lbt.loop.model_budget(unstable.system, plant)
    with pytest.raises(lbt.errors.ProblemError, match="expected a TipTiltPlant"):
        lbt.design.model_integrator(predictions.a_truth())


def test_what_is_left_of_strong_slow_lines_keeps_its_digits():
    """It is 1e-5 of the lines; the loop is the optimal one, which leaves the limit."""
    air = lbt.models.ARModel(coefficients=[0.9998], driving_rms_nm=0.01, frame_rate_hz=4000)
    lines = [
        lbt.Vibration(frequency_hz=0.2, damping=1e-3, rms_nm=1000, direction=(1,)),
        lbt.Vibration(frequency_hz=0.1, damping=0.05, rms_nm=300, direction=(1,)),
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=4000, turbulence=air, noise_nm=0.03, vibrations=lines, modes=1
    )
    truth = lbt.Truth(turbulence=air, vibrations=lines, noise_nm=0.03)
    found = lbt.residual_budget(lbt.close_loop(plant.hardware, lbt.kalman(plant)), truth)
    limit = lbt.loop.least_residual(plant.hardware, truth)
    assert found.rms_nm == pytest.approx(limit.rms_nm, rel=1e-9)
    assert lbt.lqg(plant).certificate.passed


@pytest.mark.parametrize("density", [-1.0, 1j, np.nan])
def test_a_spectrum_that_is_none_is_refused(density):
    class Odd:
        def psd(self, frequency_hz):
            return np.full(frequency_hz.shape, density)

    path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3))
    truth = lbt.Truth(turbulence=Odd(), noise_nm=1.0)
    for compute in (
        lambda: lbt.residual_budget(loop, truth),
        lambda: lbt.loop.least_residual(path, truth),
    ):
        with pytest.raises(lbt.errors.ProblemError, match="one finite number of at least 0"):
            compute()
