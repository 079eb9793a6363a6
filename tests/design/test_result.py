"""What every design is: frozen, checked, and a controller for others."""

from __future__ import annotations

import dataclasses
import sys

import control
import numpy as np
import pytest

import lbt_synth as lbt


def test_designs_are_frozen(axis_plant):
    design = lbt.kalman(axis_plant)
    with pytest.raises(dataclasses.FrozenInstanceError):
        design.method = "other"
    with pytest.raises(ValueError, match="read-only"):
        design.gain_predictor[0, 0] = 0


def test_a_wrong_solver_answer_does_not_leave_the_library(monkeypatch, axis_plant):
    """Solvers are not believed: a gain that is off by 1e-3 fails its certificate."""
    module = sys.modules["lbt_synth.design.kalman"]  # the package has the function of that name
    right = module.kalman_riccati(axis_plant)
    wrong = dataclasses.replace(right, gain_predictor=right.gain_predictor * 1.001)
    monkeypatch.setattr(module, "kalman_riccati", lambda _: wrong)
    with pytest.raises(lbt.errors.CertificateError, match="least-variance gain") as caught:
        lbt.kalman(axis_plant)
    assert caught.value.failed == (
        "distance from the least-variance gain",
        "predictor gain against the filter gain",
        "distance from its Riccati filter",
    )


def test_an_unstable_optimal_filter_does_not_leave_the_library(monkeypatch, axis_plant):
    module = sys.modules["lbt_synth.design.hinf"]

    class Liar(module._RiccatiRoute):
        def central(self, gamma):
            return dataclasses.replace(super().central(gamma), gain_predictor=np.full((4, 1), 5.0))

    monkeypatch.setattr(module, "_RiccatiRoute", Liar)
    with pytest.raises(lbt.errors.CertificateError, match="spectral radius of the filter"):
        lbt.hinf(axis_plant, gamma_ratio=1.2, route="riccati")


def test_to_control_is_the_same_controller(axis_plant):
    design = lbt.kalman(axis_plant)
    system = design.to_control()
    assert isinstance(system, control.StateSpace)
    y = np.random.default_rng(0).standard_normal(200)
    run = design.controller.start()
    stepped = [run.step([value])[0] for value in y]
    _, response = control.forced_response(system, U=y)
    assert np.allclose(np.ravel(response), stepped, rtol=1e-9, atol=1e-12)


def test_what_a_design_expects_to_leave(axis_plant):
    filter_design = lbt.kalman(axis_plant)
    assert filter_design.expected_residual_nm == filter_design.rms
    bare = lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    assert lbt.kalman(bare).expected_residual_nm is None
    assert lbt.integrator(axis_plant.hardware, gain=0.4).expected_residual_nm is None
