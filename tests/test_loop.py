"""Closed loop, exact residual, margins: against formulas and against each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.plants import lbt_axis_plant

import lbt_synth as lbt


class Anonymous:
    """A spectrum that hides that it is an AR model, so that it goes through quadrature."""

    def __init__(self, model):
        self.model = model

    def psd(self, frequency_hz):
        return self.model.psd(frequency_hz)


@given(gain=st.floats(0.2, 1.5))
def test_error_transfer_of_the_lbt(gain):
    """Error ``E = (1-h)/(1-(1-g) h)``, noise ``-z^-1 H/(1-(1-g) h)``, h = z^-2 H."""
    plant = lbt_axis_plant()
    design = lbt.kalman(plant)
    loop = lbt.close_loop(plant.hardware, design.controller, sensor_gain=gain)
    f = np.geomspace(0.1, 399, 60)
    z = np.exp(2j * np.pi * f / 800)
    closed = plant.A - design.gain_predictor @ plant.C
    H = np.array(
        [
            v * (plant.L @ np.linalg.solve(v * np.eye(4) - closed, design.gain_predictor))[0, 0]
            for v in z
        ]
    )
    h = H / z**2
    assert np.allclose(loop.sensitivity(f)[:, 0, 0], (1 - h) / (1 - (1 - gain) * h), rtol=1e-8)
    noise = -(H / z) / (1 - (1 - gain) * h)
    assert np.allclose(loop.noise_transfer(f)[:, 0, 0], noise, rtol=1e-8)


@given(gain=st.floats(0.01, 0.99), delay=st.integers(1, 4))
def test_integrator_loop_is_its_textbook_transfer_function(gain, delay):
    g = gain * lbt.design.integrator_gain_limit(delay)
    path = lbt.LoopHardware(frame_rate_hz=500, delay_frames=delay, modes=1)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=g).controller)
    z = np.exp(2j * np.pi * np.array([1.0, 40, 200]) / 500)
    open_loop = g * z**-delay / (1 - 1 / z)
    assert np.allclose(loop.sensitivity([1.0, 40, 200])[:, 0, 0], 1 / (1 + open_loop), rtol=1e-9)


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
    expected = np.trapezoid(table.psd(fine) * power, fine)
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


def test_marginal_and_unstable_loops_have_no_residual():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    truth = lbt.Truth(turbulence=None, noise_nm=1.0)
    for gain, word in ((1.0, "marginally stable"), (1.5, "unstable")):
        controller = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=1 / 800)
        loop = lbt.close_loop(path, controller)
        for ask in (
            lambda loop=loop: lbt.residual_budget(loop, truth),
            lambda loop=loop: lbt.loop_margins(loop),
        ):
            with pytest.raises(lbt.errors.UnstableLoopError, match=word) as caught:
                ask()
            assert caught.value.spectral_radius >= 1 - 1e-6
        with pytest.raises(lbt.errors.UnstableLoopError):
            lbt.simulate(controller, truth, hardware=path, frames=10)


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


# -- margins -------------------------------------------------------------------
def test_margins_of_an_integrator_against_hand_computation():
    """g z^-2/(1 - z^-1) = exp(-3j w/2) g / (2j sin(w/2)): |L| = 1 at w = 2 asin(g/2)."""
    g = 0.5
    path = lbt.LoopHardware(frame_rate_hz=1000, modes=1)
    margins = lbt.loop_margins(lbt.close_loop(path, lbt.integrator(path, gain=g).controller))
    w = 2 * np.arcsin(g / 2)
    phase = np.pi / 2 - 1.5 * w
    assert margins.crossover_hz == pytest.approx(w / (2 * np.pi) * 1000, rel=1e-9)
    assert margins.phase_deg == pytest.approx(np.degrees(phase), rel=1e-9)
    assert margins.delay_frames == pytest.approx(phase / w, rel=1e-9)
    assert margins.gain_high == pytest.approx(2.0, rel=1e-9)
    theta = np.linspace(1e-4, np.pi, 400_001)
    z = np.exp(1j * theta)
    distance = np.abs(1 + g * z**-2 / (1 - 1 / z)).min()
    assert margins.modulus == pytest.approx(distance, rel=1e-6)


@pytest.mark.parametrize("design", [lbt.kalman, lambda p: lbt.hinf(p, gamma_ratio=1.2)])
def test_the_ends_of_the_gain_interval_are_where_it_turns_unstable(design):
    plant = lbt_axis_plant(modes=2)
    controller = design(plant).controller
    low, high = lbt.loop.stable_sensor_gains(plant.hardware, controller)

    def stable(gain):
        return lbt.close_loop(plant.hardware, controller, sensor_gain=gain).is_stable

    assert all(stable(g) for g in np.geomspace(low * 1.0001, high * 0.9999, 25))
    assert not stable(low * 0.999)
    assert not stable(high * 1.001)


def test_the_delay_margin_is_where_a_longer_delay_destabilises():
    plant = lbt_axis_plant()
    controller = lbt.kalman(plant).controller
    margins = lbt.loop_margins(lbt.close_loop(plant.hardware, controller))
    f = np.geomspace(0.05, 399.9, 20_001)
    loop = lbt.close_loop(plant.hardware, controller)
    open_loop = 1 / loop.output_sensitivity().frequency_response(f)[:, 0, 0] - 1

    def distance(delay_s):
        """Least distance from -1 of the loop with a further delay."""
        return np.abs(1 + open_loop * np.exp(-2j * np.pi * f * delay_s)).min()

    assert distance(margins.delay_s) < 1e-3
    before = [distance(t) for t in np.linspace(0, 0.95, 60) * margins.delay_s]
    assert min(before) > 0.02


def test_an_unstable_nominal_has_no_interval():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    wild = lbt.Controller(A=1.0, B=3.0, C=1.0, D=0.0, dt_s=1 / 800)
    assert np.all(np.isnan(lbt.loop.stable_sensor_gains(path, wild)))
