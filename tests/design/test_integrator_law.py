"""Integrators with leak, zero and demands, against closed forms and polynomial roots."""

import dataclasses

import numpy as np
import pytest
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.design import IntegratorLaw

RATE = 800.0
PATH = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)


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
