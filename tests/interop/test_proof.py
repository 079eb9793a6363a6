"""The proof of a controller in the arithmetic of a target."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.interop.proof import Written, prove_written


def prove(design, controller, **more):
    return prove_written(design, Written(controllers={frozenset(): controller}, **more))


def test_the_controller_itself_loses_nothing(designs, shaped):
    for design in (designs["kalman"], designs["integrator"], shaped):
        checks = prove(design, design.controller)
        assert all(check.passed for check in checks)
        losses = [check.value for check in checks if check.name.endswith("loss")]
        assert losses == pytest.approx([0] * len(losses), abs=1e-12)
    names = [check.name for check in checks]
    losses = [f"residual at sensor gain {gain}, loss" for gain in ("1", "0.6")]
    assert names[:3] == ["spectral radius at sensor gains 0.5 to 1.2", *losses]
    assert len(names) > 4
    assert {f"mode 1: {check.name}" for check in shaped.recertify().checks} >= set(names[4:])


def test_another_gain_costs_residual_and_demands_and_ends_an_unstable_proof(designs, shaped):
    def failed(design, factor):
        louder = replace(design.controller, B=factor * design.controller.B)
        return {check.name: check for check in prove(design, louder) if not check.passed}

    names = {"residual at sensor gain 1, loss", "mode 1: peak of the rejection at sensor gain 1"}
    assert names <= failed(shaped, 1.1).keys()
    (unstable,) = failed(designs["integrator"], 3).values()
    assert unstable.value > 1


def test_noise_in_the_sums_is_that_of_the_closed_form():
    """With ``u(k) = u(k-1) + g y(k) + e(k)`` it obeys ``r(k) = r(k-1) - g r(k-2) - e(k-1)``."""
    g, hardware = 0.3, lbt.LoopHardware(frame_rate_hz=800, modes=1)
    design = lbt.integrator(hardware, gain=g)
    entry = replace(design.controller, B=[[1.0]], D=[[0.0]])
    size, arguments = 0.05, []

    def variance(sensor_gain, measured, commands):
        assert sensor_gain in (1.0, 0.7, 0.5, 0.358)
        arguments.append((measured, commands))
        return np.array([size])

    textbook = replace(design.controller, A=[[1.0]], B=[[g]], C=[[1.0]], D=[[0.0]])
    checks = prove(design, textbook, entry=entry, variance=variance)
    impulse = lfilter([1.0], [1.0, -1.0, g], np.eye(1, 400)[0])
    drive = np.sqrt(1 - 0.99**2)
    air = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=drive, frame_rate_hz=800)
    truth, loop = lbt.Truth(turbulence=air, noise_nm=0.1), lbt.close_loop(hardware, textbook)
    residual_nm2 = lbt.residual_budget(loop, truth, frame_means=True).rms_nm ** 2
    loss = np.sqrt(1 + size * np.sum(impulse**2) / residual_nm2) - 1
    assert checks[1].name == "residual at sensor gain 1, loss"
    assert checks[1].value == pytest.approx(loss, rel=1e-9)
    measured, _ = arguments[0]
    assert measured**2 == pytest.approx(residual_nm2 + 0.01, rel=1e-9)  # and noise


def test_demands_of_equal_modes_are_checked_once(tmp_path, shaped):
    """In a gain file they are equal by value only."""
    path = lbt.LoopHardware(frame_rate_hz=800)
    both = lbt.design.shape(path, shaped.specifications[0], functions=16, states=None)
    assert both.first_equal_modes == [0, 0]
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / "both.fits", both))
    for design in (both, loaded):
        names = [check.name for check in prove(design, design.controller)]
        assert any(name.startswith("mode 1: ") for name in names)
        assert not any(name.startswith("mode 2: ") for name in names)
