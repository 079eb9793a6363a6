"""H-infinity filters: published numbers, two routes, the least gamma, refusals."""

import sys
from functools import partial

import numpy as np
import pytest
from support.ensembles import plant as plant_of
from support.plants import lbt_axis_plant
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import InfeasibleError, NumericalError, ProblemError
from lbt_synth.linear.norms import spectral_norms

KALMAN_NM, LEAST_GAMMA_NM = 135.958, 155.5373
ONE = {"A": 0.5, "B": [[1.0, 0.0]], "C": 1.0, "D": [[0.0, 1.0]]}


def test_the_numbers_of_the_lbt(axis_plant):
    """The stable sensor gains of the Kalman filter are [.075, 1.9], at 1.05 gamma_min [.70, 1.6]."""
    kalman, near = lbt.kalman(axis_plant), lbt.hinf(axis_plant, gamma_ratio=1.05)
    assert kalman.rms == pytest.approx(KALMAN_NM, rel=1e-5)
    lmi, least = (lbt.hinf(axis_plant, route=route) for route in ("lmi", "riccati"))
    assert least.gamma == pytest.approx(LEAST_GAMMA_NM, rel=1e-5)
    assert lmi.gamma == pytest.approx(least.gamma, rel=1e-6)
    for design, gains, accuracy in ((kalman, (0.075, 1.9), 0.03), (near, (0.70, 1.6), 0.05)):
        stable = lbt.loop.stable_sensor_gains(axis_plant.hardware, design.controller)
        assert stable == pytest.approx(gains, abs=accuracy)
    # at the least gamma the error is all-pass
    error = axis_plant.error_system(least.gain_predictor)
    sigma = spectral_norms(error.frequency_response(np.linspace(0.1, 400, 200)))
    assert np.ptp(sigma) / sigma.mean() < 1e-4


def test_both_routes_bracket_slow_wind_shake_of_thousands_of_nanometres():
    """The ELT's template has poles of modulus 0.9999, and 8 um beside noise of 3 nm."""
    facts = {"coefficients": [1.998866, -0.99887], "driving_rms_nm": 0.85, "frame_rate_hz": 1000}
    slow = lbt.models.ARModel(**facts)
    shakes = [
        lbt.Vibration(frequency_hz=f, damping=0.3, rms_nm=rms, direction=way)
        for f, rms, way in ((0.75, 340.0, (1, 0)), (0.3, 8090.0, (0, 1)))
    ]
    facts = {"frame_rate_hz": 1000, "noise_nm": 2.7}
    plant = lbt.tip_tilt_plant(turbulence=slow, vibrations=shakes, **facts)
    lmi, riccati = (lbt.hinf(plant, gamma_ratio=1.2, route=m) for m in ("lmi", "riccati"))
    assert riccati.gamma_least == pytest.approx(lmi.gamma_least, rel=1e-7)
    assert riccati.gamma_infeasible == pytest.approx(riccati.gamma_least, rel=1e-7)
    assert lmi.gamma == pytest.approx(riccati.gamma, rel=1e-5)


@pytest.mark.parametrize("ratio", [1.02, 2.0])
def test_hinf_by_lmi_is_the_central_filter_of_the_riccati_equation(axis_plant, ratio):
    gamma = ratio * LEAST_GAMMA_NM
    lmi, riccati = (lbt.hinf(axis_plant, gamma=gamma, route=m) for m in ("lmi", "riccati"))
    difference = np.linalg.norm(lmi.gain_predictor - riccati.gain_predictor)
    assert difference / np.linalg.norm(riccati.gain_predictor) < 1e-6
    assert lmi.gamma <= gamma
    assert lmi.gamma_requested == gamma


def test_refusals(axis_plant):
    def hinf(plant=axis_plant, **options):
        return lambda: lbt.hinf(plant, **options)

    known = lbt.EstimationProblem(**(ONE | {"B": [[0.0, 0.0]]}), L=1.0)
    bare = "expected an EstimationProblem.*got ndarray"
    require_refusals(
        [
            (hinf(gamma=200, gamma_ratio=1.2), ProblemError, "gamma or gamma_ratio, not both"),
            (hinf(gamma=-1), ProblemError, "gamma must be above 0"),
            (hinf(gamma=np.nan), ProblemError, "gamma must be finite"),
            (hinf(gamma=1e300), ProblemError, "at most"),
            (hinf(gamma_ratio=0.9), ProblemError, "gamma_ratio must be at least 1; got 0.9"),
            (hinf(route="magic"), ProblemError, "must be one of lmi, riccati; got 'magic'"),
            (hinf(known), ProblemError, "must have an estimation error"),
            (hinf(np.eye(2)), ProblemError, bare),
            (lambda: lbt.kalman(np.eye(2)), ProblemError, bare),
            (lambda: axis_plant.ahead(-1), ProblemError, "delay of 1 to 100 frames; got -1"),
        ]
    )
    assert lbt.kalman(known).rms == 0
    for route in ("lmi", "riccati"):
        low = refused(hinf(gamma=150, route=route), InfeasibleError, r"least 155\.537.*got 150")
        assert low.gamma == 150
        assert low.gamma_least == pytest.approx(LEAST_GAMMA_NM, rel=1e-5)


def test_unstable_modes_that_no_noise_drives():
    """The stabilising solution is not the least one: doubling must not stop at P = 0."""
    pair = {"A": np.diag([2.0, 0.5]), "B": [[0.0, 0], [1, 0]], "C": [[1, 1]], "D": [[0, 1]]}
    for parts, least in ((ONE | {"A": 2.0, "B": [[0.0, 0.0]]}, 2.0), (pair, 2.828427)):
        problem = lbt.EstimationProblem(**parts, L=parts["C"])
        for route in ("riccati", "lmi"):
            assert lbt.hinf(problem, route=route).gamma == pytest.approx(least, rel=1e-6)


@pytest.mark.parametrize("seed", [33, 5])
def test_many_sensors_of_one_state_at_the_least_gamma(seed):
    rng = np.random.default_rng(seed)
    C, D = rng.standard_normal((3, 1)), np.eye(3, 4, k=1)
    D = rng.standard_normal((3, 3)) @ D
    problem = lbt.EstimationProblem(A=1.2, B=np.eye(1, 4), C=C, D=D, L=1.0)
    design = lbt.hinf(problem, route="riccati")
    assert design.gamma == pytest.approx(design.gamma_least, rel=1e-8)


def test_weakly_driven_modes_and_odd_units_are_not_refused():
    parts = {"A": np.diag([1.0, 0.5]), "D": [[0, 0, 1]]}
    weak, units = (
        lbt.EstimationProblem(**parts, B=[[b, 0, 0], [0, 1, 0]], C=[[c, 1]], L=[[c, 1]])
        for b, c in ((1e-6, 1), (1e11, 1e-11))
    )
    assert lbt.kalman(weak).certificate.passed
    assert lbt.kalman(units).rms == pytest.approx(1.6689, abs=1e-4)


def test_a_filter_below_the_infeasible_level_does_not_leave_the_library(monkeypatch, axis_plant):
    module = sys.modules["lbt_synth.design.hinf"]
    honest = module.infeasible_level
    monkeypatch.setattr(module, "infeasible_level", lambda *parts: 1.001 * honest(*parts))
    call = partial(lbt.hinf, axis_plant, route="riccati")
    refused(call, NumericalError, "no filter should have a norm below")


def test_many_states_take_the_equation_by_default():
    lines = [lbt.Vibration(frequency_hz=12.0 + 3 * i, damping=0.01, rms_nm=20.0) for i in range(9)]
    for count, route in ((0, "lmi"), (2, "lmi"), (9, "riccati")):
        plant = plant_of(vibrations=lines[:count])
        design = lbt.hinf(plant, gamma_ratio=1.2)
        assert design.solver.route == route
        assert (len(plant.A) > 20) == (route == "riccati")
        assert design.certificate.passed


@pytest.mark.parametrize("make", [lbt.kalman, partial(lbt.hinf, gamma_ratio=1.2, route="riccati")])
def test_a_horizon_is_a_delay_of_the_loop(make):
    """On a plant of delay 2, filter and two-step prediction are the loops of delay 1 and 3."""
    p = lbt_axis_plant()
    bare = lbt.EstimationProblem(A=p.A, B=p.B, C=p.C, D=p.D, L=p.L, dt_s=p.dt_s)
    for horizon, delay in ((0, 1), (3, 4)):
        shifted, direct = make(p.ahead(horizon)), make(lbt_axis_plant(delay_frames=delay))
        assert shifted.hardware.delay_frames == delay
        assert (shifted.rms, shifted.gamma) == pytest.approx((direct.rms, direct.gamma), rel=1e-9)
        # and of the general construction, which knows nothing of telescopes
        assert make(bare.ahead(horizon)).rms == pytest.approx(direct.rms, rel=1e-9)


def test_noise_far_below_the_signal_is_left_to_the_equation():
    """The inequality's gain is singular there; the equation needs no inverse."""
    quiet = lbt.EstimationProblem(**(ONE | {"D": [[0.0, 1e-6]]}), L=1.0).ahead(0)
    refused(lambda: lbt.hinf(quiet, route="lmi"), NumericalError, "riccati")
    design = lbt.hinf(quiet)
    assert design.solver.route == "riccati"
    assert design.gamma == pytest.approx(1e-6, rel=1e-3)
