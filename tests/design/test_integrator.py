"""Integrators: their limits, their best gains, and laws with leak, zero and demands."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.predictions import a_plant, truth_of_all_moments
from support.refusals import require_refusals
from support.uneven_axes import QUICK, RATE, SLOW

import lbt_synth as lbt
from lbt_synth.design import IntegratorLaw, integrator, integrator_gain_limit
from lbt_synth.errors import CertificateError, DimensionError, InfeasibleError, ProblemError
from lbt_synth.models import ARModel

PATH = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)


@settings(max_examples=10)
@given(delay=st.floats(1, 4.5))
@example(4.0)
def test_the_limit_is_where_the_loop_turns_unstable(delay):
    path = lbt.LoopHardware(frame_rate_hz=1, delay_frames=delay, modes=1)
    gains = integrator_gain_limit(path) * np.array([1 - 1e-4, 1 + 1e-4])
    laws = [lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0) for gain in gains]
    assert [lbt.close_loop(path, law).spectral_radius < 1 for law in laws] == [True, False]


@pytest.mark.parametrize("sensor_gain", [1.0, 0.6])
def test_the_best_gain_is_the_least_of_two_minima(sensor_gain):
    """A line above the bandwidth wants hardly any loop, or a fast one."""
    path = lbt.LoopHardware(frame_rate_hz=500, delay_frames=3, modes=1)
    line = lbt.models.SinusoidalVibration(frequency_hz=28.5, rms_nm=38.76, direction=(1,))
    air = ARModel(coefficients=[0.9926], driving_rms_nm=2.27, frame_rate_hz=500)
    facts = {"noise_nm": 6.94 * sensor_gain, "sensor_gain": sensor_gain}
    truth = lbt.Truth(turbulence=air, vibrations=(line,), **facts)

    def residual(gain):
        law = lbt.integrator(path, gain=gain / sensor_gain)
        loop = lbt.close_loop(path, law, sensor_gain=sensor_gain)
        return lbt.residual_budget(loop, truth).rms_nm

    best = residual(integrator(path, truth=truth).gain * sensor_gain)
    assert residual(0.0117) < min(residual(0.005), residual(0.03))  # the other minimum
    assert best <= min(map(residual, np.linspace(0.005, min(0.615, sensor_gain * 0.61), 62)))


def test_reconstructor_inverts_any_sensor():
    rng = np.random.default_rng(0)
    sensor, influence = rng.standard_normal((5, 2)), rng.standard_normal((2, 2))
    path = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=sensor, influence_matrix=influence)
    loops = (
        lbt.close_loop(p, lbt.integrator(p, gain=0.4))
        for p in (path, lbt.LoopHardware(frame_rate_hz=800))
    )
    one, other = (loop.sensitivity([0.5, 10, 100]) for loop in loops)
    assert np.allclose(one, other, atol=1e-12)


FLAT = [(None, [[1, 0, 1], [0, 1, 1]]), (None, [[1, 1], [1, 1]]), ([[1, 0.5]], None)]
FLAT += [([[1 / 3, 2 / 3], [1 / 6, 1 / 3]], [[1, 0.1], [0.3, 7]])]


@pytest.mark.parametrize(("sensor", "influence"), FLAT)
@pytest.mark.parametrize("law", [IntegratorLaw(), IntegratorLaw(integrators=2, zero_hz=5)])
def test_what_is_seen_and_moved_has_the_usual_loop_and_the_rest_has_none(sensor, influence, law):
    path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=sensor, influence_matrix=influence)
    design, usual = (lbt.integrator(p, gain=0.3, law=law) for p in (path, PATH))
    one, other = (lbt.close_loop(d.hardware, d).sensitivity([1, 99]) for d in (design, usual))
    corrected = path.influence @ np.linalg.pinv(path.sensor @ path.influence, 1e-9) @ path.sensor
    assert np.allclose(one, np.eye(2) + (other - 1) * corrected, atol=1e-9)
    truth = lbt.Truth(turbulence=SLOW, noise_nm=5.0)
    assert lbt.integrator(path, truth=truth, law=law).solver.status == "least residual"


def test_the_integrator_of_a_plant_is_that_of_its_truth():
    plant = a_plant(delay=2.49)
    design = integrator(plant.hardware, truth=plant)
    of_truth = integrator(plant.hardware, truth=truth_of_all_moments())
    assert design.gain == pytest.approx(of_truth.gain, rel=1e-5)
    assert design.certificate.passed


def test_where_no_loop_is_best_the_status_says_so():
    """White noise alone: each gain adds to it, the least that is tried adds least."""
    idle = integrator(PATH, truth=lbt.Truth(turbulence=None, noise_nm=20.0))
    assert idle.solver.status.startswith("limited by the least gain tried")
    assert idle.gain == pytest.approx(1e-4, rel=1e-3)


def test_margins_of_a_pure_integrator_have_closed_forms():
    """The phase margin is pi/2 - 3 asin(g/2) at two frames; the modulus margin a distance."""
    for demand in (30, 60):
        design = lbt.integrator(PATH, law=IntegratorLaw(phase_margin_deg=demand))
        assert design.gain == pytest.approx(2 * np.sin(np.radians((90 - demand) / 3)), rel=1e-6)
        assert lbt.loop_margins(lbt.close_loop(PATH, design.controller)).phase_deg >= demand
    design = lbt.integrator(PATH, law=IntegratorLaw(modulus_margin=0.5))
    z = np.exp(1j * np.linspace(1e-4, np.pi, 200_001))
    assert np.abs(1 + design.gain * z**-2 / (1 - 1 / z)).min() == pytest.approx(0.5, abs=1e-7)


LAWS = [
    (IntegratorLaw(leak=0.9), 0.3, 1),
    (IntegratorLaw(zero_hz=150), 0.25, 2),
    (IntegratorLaw(leak=0.97, zero_hz=60), 0.25, 3),
    (IntegratorLaw(integrators=2, zero_hz=8, leak=0.99), 0.2, 2),
]


@pytest.mark.parametrize(("law", "gain", "delay"), LAWS)
def test_a_law_has_its_response_and_the_loop_the_poles_of_its_polynomial(law, gain, delay):
    """``(1 - leak z^-1)^n + g z^-d (1 - c z^-1) = 0``."""
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    design = lbt.integrator(hardware, gain=gain, law=law)
    c = 0 if law.zero_hz is None else np.exp(-2 * np.pi * law.zero_hz / RATE)
    late, double = (np.poly1d([1.0] + [0.0] * n) for n in (delay + 1, law.integrators))
    zero = np.poly1d([gain, -gain * c]) * double
    expected = (np.poly1d([1.0, -law.leak]) ** law.integrators * late + zero).roots
    for pole in expected[np.abs(expected) > 1e-3]:
        assert np.min(np.abs(design.poles - pole)) < 1e-6
    leaks = np.linalg.eigvals(design.controller.A)
    assert leaks == pytest.approx([law.leak] * law.integrators)
    f = np.array([1.0, 20.0, 300.0])
    z = np.exp(2j * np.pi * f / RATE)
    response = design.controller.to_statespace().frequency_response(f)[:, 0, 0]
    expected = gain * (1 - c / z) / (1 - law.leak / z) ** law.integrators
    assert np.allclose(response, expected, rtol=1e-9)


def test_a_double_integrator_is_stable_where_its_zero_leads_more_than_the_delay_lags():
    """At small gains for c / (1 - c) + 1 above the delay: zero_hz below rate ln(2) / (2 pi)."""
    highest = RATE * np.log(2) / (2 * np.pi)
    slow = IntegratorLaw(integrators=2, zero_hz=0.97 * highest)
    assert lbt.integrator(PATH, gain=1e-3, law=slow).certificate.passed
    for zero_hz in (1.03 * highest, None):
        law = IntegratorLaw(integrators=2, zero_hz=zero_hz, modulus_margin=0.01)
        with pytest.raises(InfeasibleError, match="zero_hz below 88.3"):
            lbt.integrator(PATH, law=law)


def test_the_best_gain_within_a_demand():
    air = ARModel(coefficients=[0.999], driving_rms_nm=30, frame_rate_hz=RATE)
    truth = lbt.Truth(turbulence=air, noise_nm=1.0)
    laws = (IntegratorLaw(phase_margin_deg=demand) for demand in (None, 50, 5))
    free, bound, easy = (integrator(PATH, truth=truth, law=law) for law in laws)
    assert free.gain > bound.gain == pytest.approx(2 * np.sin(np.radians(40 / 3)), rel=1e-5)
    assert easy.gain == pytest.approx(free.gain, rel=1e-5)
    status = [design.solver.status for design in (bound, easy)]
    assert status == ["limited by the margin demanded", "least residual"]


def test_refusals():
    def designed(gain=None, truth=None, path=PATH, **law):
        return lambda: integrator(path, gain=gain, truth=truth, law=IntegratorLaw(**law))

    still = lbt.Truth(turbulence=None, noise_nm=0.0)
    two = lbt.Truth(turbulence=[SLOW, QUICK], noise_nm=5.0)
    noisy = lbt.Truth(turbulence=SLOW, noise_nm=[5, 5])
    modes, measurements = r"one per mode \(1\); got 2", r"one per measurement \(1\); got 2"
    run = partial(lbt.simulate, designed(0.4)(), two, hardware=PATH, frames=9)
    facts = {"frame_rate_hz": RATE, "turbulence": SLOW, "noise_nm": [1.0]}
    require_refusals(
        [
            (designed(1.01), CertificateError, "spectral radius of the closed loop"),
            (designed(1.0), CertificateError, "spectral radius"),  # marginal
            (designed(0.0), ProblemError, "gain must be above 0"),
            (designed(phase_margin_deg=95), InfeasibleError, "no gain keeps phase_margin_deg 95"),
            (designed(), ProblemError, "a gain, a truth or a demand; got none"),
            (designed(0.1, zero_hz=400), ProblemError, "zero_hz must be below half the frame rate"),
            (designed(0.55, phase_margin_deg=45), CertificateError, "phase margin demanded over"),
            (designed(leak=1.01), ProblemError, "leak"),
            (designed(integrators=3), ProblemError, "integrators"),
            (designed(modulus_margin=1.0), ProblemError, "modulus_margin"),
            (designed(truth=still), ProblemError, "must disturb the loop"),
            (designed(truth=PATH), ProblemError, "truth must be a Truth; got LoopHardware"),
            (designed(0.1, truth=still), ProblemError, "a gain or a truth; got both"),
            (designed(0.1, path=3), ProblemError, "hardware must be a LoopHardware"),
            (lambda: integrator_gain_limit(3), ProblemError, "hardware must be a LoopHardware"),
            (designed(truth=two), DimensionError, modes),
            (designed(truth=noisy), DimensionError, measurements),
            (lambda: lbt.loop.least_residual(PATH, two), DimensionError, modes),
            (run, DimensionError, modes),
            (lambda: lbt.tip_tilt_plant(**facts), DimensionError, "measurement"),
        ]
    )
    assert designed(0.5, phase_margin_deg=45)().certificate.passed


def test_a_gain_file_keeps_the_law_and_its_claim(tmp_path):
    law = IntegratorLaw(leak=0.99, integrators=2, zero_hz=5, modulus_margin=0.5)
    design = lbt.integrator(PATH, law=law)
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / "double.npz", design))
    assert (loaded.law, loaded.gain) == (law, design.gain)
    assert len(loaded.certificate.checks) == 2
    bold = replace(design, claims=design.claims | {"modulus_margin": 0.6})
    with pytest.raises(lbt.errors.GainFileError, match="modulus margin demanded over achieved"):
        lbt.load_gain(lbt.save_gain(tmp_path / "bold.npz", bold))
