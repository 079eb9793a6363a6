"""Integrators: their limits, their best gains, and laws with leak, zero and demands."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from support.plants import LBT_YAML
from support.predictions import SHELL, a_plant, truth_of_all_moments
from support.uneven_axes import LOOPS, QUICK, RATE, SLOW

import lbt_synth as lbt
from lbt_synth.design import IntegratorLaw

PATH = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)


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


def corner(zero_hz):
    return np.exp(-2 * np.pi * zero_hz / RATE)


def test_the_phase_margin_of_a_pure_integrator_has_a_closed_form():
    """pi/2 - 3 asin(g/2) at two frames."""
    for demand in (30, 45, 60):
        design = lbt.integrator(PATH, law=IntegratorLaw(phase_margin_deg=demand))
        assert design.gain == pytest.approx(2 * np.sin(np.radians((90 - demand) / 3)), rel=1e-6)
        assert lbt.loop_margins(lbt.close_loop(PATH, design.controller)).phase_deg >= demand


def test_the_modulus_margin_is_the_least_distance_from_minus_one():
    design = lbt.integrator(PATH, law=IntegratorLaw(modulus_margin=0.5))
    z = np.exp(1j * np.linspace(1e-4, np.pi, 200_001))
    distance = np.abs(1 + design.gain * z**-2 / (1 - 1 / z))
    assert distance.min() == pytest.approx(0.5, abs=1e-7)


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize(
    ("law", "gain"),
    [
        (IntegratorLaw(leak=0.9), 0.3),
        (IntegratorLaw(zero_hz=150), 0.25),
        (IntegratorLaw(leak=0.97, zero_hz=60), 0.25),
        (IntegratorLaw(integrators=2, zero_hz=8), 0.2),
        (IntegratorLaw(integrators=2, zero_hz=8, leak=0.99), 0.2),
    ],
)
def test_the_loop_has_the_poles_of_its_polynomial(law, gain, delay):
    """``(1 - leak z^-1)^n + g z^-d (1 - c z^-1) = 0``."""
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    c = 0 if law.zero_hz is None else corner(law.zero_hz)
    whole = np.poly1d([1.0, -law.leak]) ** law.integrators * np.poly1d([1.0] + [0.0] * (delay + 1))
    zero = np.poly1d([gain, -gain * c]) * np.poly1d([1.0] + [0.0] * law.integrators)
    expected = (whole + zero).roots
    poles = lbt.integrator(hardware, gain=gain, law=law).poles
    for pole in expected[np.abs(expected) > 1e-3]:
        assert np.min(np.abs(poles - pole)) < 1e-6


def test_the_controller_has_its_leak_as_pole_and_its_response():
    z = np.exp(2j * np.pi * np.array([1.0, 20.0, 300.0]) / RATE)
    for law in (
        IntegratorLaw(leak=0.95),
        IntegratorLaw(zero_hz=30),
        IntegratorLaw(integrators=2, leak=0.99, zero_hz=5),
    ):
        controller = lbt.integrator(PATH, gain=0.2, law=law).controller
        assert np.linalg.eigvals(controller.A) == pytest.approx([law.leak] * law.integrators)
        c = 0 if law.zero_hz is None else corner(law.zero_hz)
        expected = 0.2 * (1 - c / z) / (1 - law.leak / z) ** law.integrators
        f = np.angle(z) / (2 * np.pi) * RATE
        found = controller.to_statespace().frequency_response(f)[:, 0, 0]
        assert np.allclose(found, expected, rtol=1e-9)


def test_a_double_integrator_is_stable_where_its_zero_leads_more_than_the_delay_lags():
    """At small gains for c / (1 - c) + 1 above the delay: zero_hz below rate ln(2) / (2 pi)."""
    highest = RATE * np.log(2) / (2 * np.pi)
    slow = IntegratorLaw(integrators=2, zero_hz=0.97 * highest)
    assert lbt.integrator(PATH, gain=1e-3, law=slow).certificate.passed
    for zero_hz in (1.03 * highest, None):
        law = IntegratorLaw(integrators=2, zero_hz=zero_hz, modulus_margin=0.01)
        with pytest.raises(lbt.errors.InfeasibleError, match="zero_hz below 88.3"):
            lbt.integrator(PATH, law=law)


def test_the_best_gain_within_a_demand():
    noise = lbt.Truth(
        turbulence=lbt.models.ARModel(coefficients=[0.999], driving_rms_nm=30, frame_rate_hz=RATE),
        noise_nm=1.0,
    )
    free = lbt.design.optimal_integrator(PATH, noise)
    bound = lbt.design.optimal_integrator(PATH, noise, law=IntegratorLaw(phase_margin_deg=50))
    assert bound.gain < free.gain
    assert bound.gain == pytest.approx(2 * np.sin(np.radians(40 / 3)), rel=1e-5)
    assert bound.solver.status == "limited by the margin demanded"
    easy = lbt.design.optimal_integrator(PATH, noise, law=IntegratorLaw(phase_margin_deg=5))
    assert easy.gain == pytest.approx(free.gain, rel=1e-5)
    assert easy.solver.status == "least residual"


def test_a_demand_that_a_given_gain_does_not_keep_fails_the_certificate():
    law = IntegratorLaw(phase_margin_deg=45)
    assert lbt.integrator(PATH, gain=0.5, law=law).certificate.passed
    with pytest.raises(lbt.errors.CertificateError, match="phase margin demanded over achieved"):
        lbt.integrator(PATH, gain=0.55, law=law)


def test_impossible_demands_are_refused():
    with pytest.raises(lbt.errors.InfeasibleError, match="no gain keeps phase_margin_deg 95"):
        lbt.integrator(PATH, law=IntegratorLaw(phase_margin_deg=95))
    with pytest.raises(lbt.errors.ProblemError, match="a gain or a demand; got neither"):
        lbt.integrator(PATH)
    with pytest.raises(lbt.errors.ProblemError, match="zero_hz must be below half the frame rate"):
        lbt.integrator(PATH, gain=0.1, law=IntegratorLaw(zero_hz=400))
    for wrong in ({"leak": 1.01}, {"integrators": 3}, {"modulus_margin": 1.0}):
        with pytest.raises(lbt.errors.ProblemError, match=next(iter(wrong))):
            IntegratorLaw(**wrong)


def test_a_gain_file_keeps_the_law_and_its_claim(tmp_path):
    law = IntegratorLaw(leak=0.99, integrators=2, zero_hz=5, modulus_margin=0.5)
    design = lbt.integrator(PATH, law=law)
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / "double.npz", design))
    assert (loaded.law, loaded.gain) == (law, design.gain)
    assert len(loaded.certificate.checks) == 2
    bold = dataclasses.replace(design, claims={**design.claims, "modulus_margin": 0.6})
    with pytest.raises(lbt.errors.GainFileError, match="modulus margin demanded over achieved"):
        lbt.load_gain(lbt.save_gain(tmp_path / "bold.npz", bold))


def test_a_configuration_gives_the_law_of_its_baseline(tmp_path):
    text = LBT_YAML.read_text().replace(
        "\ndesign:\n", "\ndesign:\n  integrator: {phase_margin_deg: 45}\n"
    )
    (tmp_path / "own.yaml").write_text(text)
    config = lbt.load_config(tmp_path / "own.yaml")
    assert config.design("integrator").law == IntegratorLaw(phase_margin_deg=45)
    other = config.design("integrator", modulus_margin=0.6)  # a demand replaces that of the file
    assert other.law == IntegratorLaw(modulus_margin=0.6)
    assert config.design("integrator", gain=0.2).law == IntegratorLaw()
