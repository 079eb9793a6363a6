"""LQG designs: other disturbances, certificates that fail."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from support.lqg import shell, slow_plant

import lbt_synth as lbt


def test_other_disturbances_meet_the_same_loop():
    plant = slow_plant(2.25, shell())
    design = lbt.lqg(plant)
    moved = lbt.models.retuned_plant(plant, 2.0)
    assert astuple(moved.hardware.mirror) == astuple(plant.hardware.mirror)
    error = design.error_system(moved)
    from lbt_synth.linear.lyapunov import stationary_covariance

    X = stationary_covariance(error.A, error.B @ error.B.T)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5, vibrations=moved.vibrations)
    budget = lbt.residual_budget(lbt.close_loop(plant.hardware, design.controller), truth)
    assert np.sqrt(error.C @ X @ error.C.T)[0, 0] == pytest.approx(budget.rms_nm, rel=1e-8)
    with pytest.raises(lbt.errors.ProblemError, match="must come in a TipTiltPlant"):
        design.error_system(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    with pytest.raises(lbt.errors.ProblemError, match="must have 4 states"):
        design.error_system(slow_plant(2.25, shell(), vibrations=None))


@pytest.mark.parametrize("field", ["gain_predictor", "gain_state", "gain_mirror", "objective_nm"])
def test_changed_gains_fail_the_certificate(field):
    design = lbt.lqg(slow_plant(2.0, shell()))
    assert design.recertify().passed
    value = getattr(design, field)
    changed = replace(design, **{field: value * (1 + 1e-4)})
    certificate = changed.recertify()
    assert not certificate.passed
    with pytest.raises(lbt.errors.CertificateError):
        certificate.require()


def test_a_changed_controller_fails_the_certificate():
    design = lbt.lqg(slow_plant(2.0, shell()))
    K = design.controller
    changed = lbt.Controller(A=K.A, B=K.B * 1.0001, C=K.C, D=K.D, dt_s=K.dt_s)
    failed = [
        c.name for c in replace(design, controller=changed).recertify().checks if not c.passed
    ]
    assert "controller against its gains" in failed
