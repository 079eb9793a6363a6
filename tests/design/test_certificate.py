"""Certificates refuse what is not so."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.design.certificate import (
    Check,
    certify_error,
    certify_filter,
    certify_infeasible,
    say_checks,
)
from lbt_synth.errors import CertificateError, DimensionError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.infeasibility_proof import Witness


def test_certificate_checks_are_independent(axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.2)
    assert {
        "spectral radius of the filter",
        "norm of the estimation error over its bound, less 1",
        "spectral radius of the closed loop",
    } <= {check.name for check in design.certificate.checks}
    assert design.recertify().passed
    tighter = replace(design, claims={**design.claims, "gamma_requested": 0.99 * design.gamma})
    with pytest.raises(CertificateError, match="norm of the estimation error"):
        tighter.recertify().require()
    assert not certify_filter(axis_plant, np.full((4, 1), 9.0)).passed


def test_a_variance_that_rounding_has_spoilt_is_not_certified():
    """Two Lyapunov equations that sum it in different orders have to agree."""
    rng, spoilt = np.random.default_rng(0), 0
    for _ in range(40):
        one, other = rng.standard_normal((2, 4, 4))
        turn = one @ np.diag([1, 1e-3, 1e-6, 1e-9]) @ other
        A = turn @ np.diag([0.5, 0.4, 0.3, 0.2]) @ np.linalg.inv(turn)
        B, C, D, L = (rng.standard_normal(size) for size in ((4, 5), (1, 4), (1, 5), (1, 4)))
        try:
            design = lbt.kalman(lbt.EstimationProblem(A=A, B=B, C=C, D=D, L=L))
        except lbt.LbtSynthError:
            spoilt += 1
            continue
        check = next(c for c in design.certificate.checks if "adjoint" in c.name)
        assert check.value < 1e-6
    assert 0 < spoilt


@pytest.mark.parametrize("apart", [2.0**-10, 2.0**-14])
def test_variance_of_a_system_far_from_normal(apart):
    """Two modes have nearly the same direction: coefficients of 6,500, and sums that cancel."""
    modes = np.array([[1.0, 1.0], [1.0, 1.0 + apart]])
    A = modes @ np.diag([0.9, 0.5]) @ np.linalg.inv(modes)
    certificate = certify_error(StateSpace(A=A, B=[[1.0], [0.0]], C=[[1.0, 0.0]], D=[[0.0]]))
    assert certificate.passed
    with mpmath.workdps(60):
        power, exact = mpmath.matrix(A.tolist()), mpmath.matrix([[1, 0], [0, 0]])
        for _ in range(12):
            exact, power = exact + power * exact * power.T, power * power
    assert certificate.rms**2 == pytest.approx(float(exact[0, 0]), rel=2e-7)


@pytest.mark.parametrize(("off", "passes"), [(0.7e-6, True), (1.5e-6, False)])
def test_a_gain_beside_the_optimal_one_is_refused_from_a_millionth_on(axis_plant, off, passes):
    gain = (1 + off) * lbt.kalman(axis_plant).gain_predictor
    certificate = certify_filter(axis_plant, gain, least_variance=True)
    distance = next(c for c in certificate.checks if "least-variance gain" in c.name)
    assert distance.value == pytest.approx(off, rel=1e-3)
    assert certificate.passed is passes


def test_what_is_no_witness_of_the_problem_is_refused():
    problem = lbt.EstimationProblem(A=0.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    still = np.zeros((2, 1))
    nothing, wide = (Witness(states=np.zeros((n, 1)), disturbances=still) for n in (1, 2))
    assert certify_infeasible(problem, 0.0, nothing).passed  # a level of zero claims nothing
    assert not certify_infeasible(problem, 1e-3, nothing).passed
    words = r"1 rows of states, 2 rows of disturbances .*; got \(2, 1\) and \(2, 1\)"
    with pytest.raises(DimensionError, match=words):
        certify_infeasible(problem, 1.0, wide)


def test_a_sentence_counts_the_checks():
    good, bad = (Check("norm", value, 1.0, "by hand") for value in (0.5, 2.0))
    assert say_checks([good, good]) == "2 of 2 checks passed."
    assert say_checks([good, bad]) == "1 of 2 checks passed; 1 FAILED."
