"""The proof of a controller in the arithmetic of a target."""

from dataclasses import replace

import numpy as np
import pytest
from support.exports import lbt_designs

import lbt_synth as lbt
from lbt_synth.interop.proof import Written, prove_written


def prove(design, controller, **more):
    return prove_written(design, Written(controllers={frozenset(): controller}, **more))


@pytest.mark.parametrize("name", ["kalman", "integrator"])
def test_the_controller_itself_loses_nothing(name):
    design = lbt_designs()[name]
    checks = prove(design, design.controller)
    assert all(check.passed for check in checks)
    assert [c.value for c in checks[1:]] == pytest.approx([0] * len(checks[1:]), abs=1e-12)


def test_an_unstable_loop_ends_the_proof():
    design = lbt_designs()["integrator"]
    louder = replace(design.controller, B=3 * design.controller.B, D=3 * design.controller.D)
    (only,) = prove(design, louder)
    assert not only.passed
    assert only.value > 1


def test_a_shaped_design_keeps_its_demands(shaped):
    checks = prove(shaped, shaped.controller)
    assert all(check.passed for check in checks)
    names = [check.name for check in checks]
    assert names[:3] == [
        "spectral radius at sensor gains 0.5 to 1.2",
        "residual at sensor gain 1, loss",
        "residual at sensor gain 0.6, loss",
    ]
    own = shaped.recertify().checks
    assert {f"mode 1: {check.name}" for check in own} >= set(names[4:])
    assert len(names) > 4


def test_another_gain_costs_residual_and_demands(shaped):
    louder = replace(shaped.controller, C=1.1 * shaped.controller.C, D=1.1 * shaped.controller.D)
    failed = {check.name for check in prove(shaped, louder) if not check.passed}
    assert "residual at sensor gain 1, loss" in failed
    assert "mode 1: peak of the rejection at sensor gain 1" in failed


def test_noise_in_the_sums_is_that_of_the_closed_form():
    """An integrator ``u(k) = u(k-1) + g y(k) + e(k)``.

    With ``phi_cor(k) = u(k-1)`` the noise obeys ``r(k) = r(k-1) - g r(k-2) - e(k-1)``; its
    variance is summed from its impulse response.
    """
    g, hardware = 0.3, lbt.LoopHardware(frame_rate_hz=800, modes=1)
    design = lbt.integrator(hardware, gain=g)
    entry = replace(design.controller, B=[[1.0]], D=[[0.0]])
    size = 0.05
    seen = []

    def variance(sensor_gain, measured, commands):
        assert sensor_gain in (1.0, 0.7, 0.5, 0.358)
        seen.append((measured, commands))
        return np.array([size])

    own = replace(design.controller, A=[[1.0]], B=[[g]], C=[[1.0]], D=[[0.0]])
    checks = prove(design, own, entry=entry, variance=variance)
    impulse = [0.0, 1.0]
    for _ in range(400):
        impulse.append(impulse[-1] - g * impulse[-2])
    air = lbt.models.ARModel(
        coefficients=[0.99], driving_rms_nm=np.sqrt(1 - 0.99**2), frame_rate_hz=800
    )
    truth = lbt.Truth(turbulence=air, noise_nm=0.1)
    loop = lbt.close_loop(hardware, own)
    left = lbt.residual_budget(loop, truth, frame_means=True).rms_nm ** 2
    expected = np.sqrt(1 + size * np.sum(np.square(impulse)) / left) - 1
    assert checks[1].name == "residual at sensor gain 1, loss"
    assert checks[1].value == pytest.approx(expected, rel=1e-9)
    assert seen[0][0] ** 2 == pytest.approx(left + 0.01, rel=1e-9)  # y is the residual and noise


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
