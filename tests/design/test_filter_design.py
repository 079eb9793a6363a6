"""Certified filters of several sensors: claims that are refused, and sensors that fail."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support import sensor_loops
from support.refusals import require_refusals
from support.sensor_loops import FAST, MOTIONS, SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.design.filter_design import failed_loop, failure_rows, failure_sets, make_fallbacks
from lbt_synth.errors import InfeasibleError, ProblemError
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop.budget import model_covariances, residual_budget
from lbt_synth.models import WavefrontSensor

BOUND = "norm of the estimation error over its bound, less 1"
PROOF = "infeasible level over the level proved, less 1"


@cache
def designed(sensors, **changes):
    plant = example_plant(sensors, **changes)
    return plant, kalman_riccati(plant).gain_predictor, make_fallbacks(plant)


@pytest.fixture(scope="module")
def kalman():
    return lbt.kalman(designed((FAST, SLOW))[0])


@pytest.fixture(scope="module", params=[(), (SLOW,)], ids=["one sensor", "two sensors"])
def hinf(request):
    return lbt.hinf(example_plant(request.param), gamma_ratio=1.1)


def failed(design, **changes):
    """Return the names of the checks that a design with changes fails."""
    checks = replace(design, **changes).recertify().checks
    return {check.name for check in checks if not check.passed}


def test_a_certified_filter(kalman):
    assert kalman.certificate.passed
    plant = kalman.problem
    P = kalman_riccati(plant).P
    per_output = np.mean([np.diag(plant.L @ one @ plant.L.T) for one in P], axis=0)
    np.testing.assert_allclose(kalman.certificate.rms_per_output**2, per_output, rtol=1e-9)
    assert kalman.rms == pytest.approx(np.sqrt(per_output.sum()))
    assert kalman.gamma > kalman.rms / np.sqrt(2)
    assert kalman.other_sensors == ("truth", "m1", "m2")
    assert len(kalman.fallbacks) == len(kalman.controllers) - 1 == 15
    assert np.abs(kalman.poles).max() < 1
    marked = plant.hardware.suite.marked(("m1", "truth"), plant.hardware)
    assert not kalman.fallbacks["truth", "m1"][:, :, marked].any()
    alone = lbt.kalman(plant.own_sensor_alone())
    assert (alone.fallbacks, alone.other_sensors, alone.tables()) == ({}, (), ())
    assert kalman.rms < lbt.kalman(example_plant((FAST,))).rms < alone.rms  # each sensor helps


def test_gains_and_fallbacks_that_are_wrong(kalman):
    gains, fallbacks = kalman.gain_predictor, kalman.fallbacks
    first, *_, last = fallbacks
    pairs = list(fallbacks.items())
    distance = {"distance from the least-variance gains of any fall-back"}
    for some, names in (
        (fallbacks | {first: 1.001 * fallbacks[first]}, distance),
        (fallbacks | {first: gains}, distance),
        (dict(pairs[1:]), {"sets of failed sensors without a fall-back"}),
        (dict(pairs[::-1]), {"sets of failed sensors without a fall-back"}),
    ):
        assert failed(kalman, fallbacks=some) == names
    assert failed(kalman, fallbacks=fallbacks | {last: 1e-3 * gains})
    triple = failed(kalman, gain_predictor=3 * gains)
    assert "spectral radius of the filter over a period" in triple
    diverging = failed(kalman, fallbacks=fallbacks | {first: 20 * fallbacks[first]})
    assert "spectral radius of any loop with sensors missing" in diverging


def test_an_hinf_filter(hinf):
    assert hinf.certificate.passed
    assert hinf.gamma_requested == pytest.approx(1.1 * hinf.gamma_least)
    assert hinf.gamma_least < hinf.gamma < hinf.gamma_requested
    same, least = lbt.hinf(hinf.problem, gamma=hinf.gamma_requested), lbt.hinf(hinf.problem)
    assert same.gain_predictor == pytest.approx(hinf.gain_predictor)
    assert (least.gamma, least.gamma_least) == pytest.approx((hinf.gamma_least,) * 2, rel=1e-6)


def test_claims_of_an_hinf_filter_that_are_wrong(hinf):
    least = hinf.gamma_least
    assert hinf.gamma_infeasible == pytest.approx(least, rel=1e-6)
    low = "level proved over the infeasible level, less 1"
    distance = "distance from its Riccati filter, or of the norm from its bound"
    for claim, value, names in (
        ("gamma_least", 0.9 * least, {"least norm of any filter, error"}),
        ("gamma_least", 1.1 * least, {"least norm of any filter, error"}),
        ("gamma_infeasible", 1.001 * least, {PROOF}),
        ("gamma_infeasible", 0.9 * least, {low}),
        ("gamma_requested", 0.99 * hinf.gamma, {BOUND, distance}),
    ):
        assert failed(hinf, claims=hinf.claims | {claim: value}) == names
    assert failed(hinf, witness=None) == {PROOF}
    gain = lbt.kalman(hinf.problem).gain_predictor
    norms = (
        f"estimation error, {name}, against the one claimed" for name in ("rms", "H-infinity norm")
    )
    assert failed(hinf, gain_predictor=gain) == {BOUND, *norms}


def test_the_loop_of_one_rate_is_that_of_the_filter():
    fast = WavefrontSensor(name="other", rate_hz=1000, delay_frames=2, noise_nm=1e7)
    design = lbt.kalman(example_plant((fast,)))
    hardware, alone = design.hardware, lbt.kalman(design.problem.own_sensor_alone())
    loop = lbt.close_loop(hardware, alone)
    assert not loop.reads_others
    assert design.rms == pytest.approx(alone.rms, rel=1e-6)
    facts = design.derived()
    assert facts["loop_radius"] == pytest.approx(loop.spectral_radius, rel=1e-6)
    gains = lbt.loop.stable_sensor_gains(hardware, alone)
    assert (facts["gain_low"], facts["gain_high"]) == pytest.approx(gains, rel=1e-3, abs=2e-3)
    other = design.close(hardware.own_sensor_alone(), sensor_gain=0.5)
    assert (other.reads_others, other.sensor_gain) == (True, 0.5)


def test_refusals():
    plant, own = example_plant((SLOW,)), "reads the loop's own sensor"
    many = replace(FAST, name="many", channels=tuple("abcdef"), noise_m_s2=1e-3)
    crowded = example_plant((many,), motions=({}, {}))
    taps = "an impulse response on the innovations needs a period of 1"
    require_refusals(
        [
            (lambda: lbt.hinf(plant, route="lmi"), ProblemError, "route='riccati'"),
            (lambda: lbt.mixed(plant, gamma=1.0), InfeasibleError, "at least"),
            (lambda: lbt.mixed(plant, gamma_ratio=1.1, taps=4), ProblemError, taps),
            (lambda: lbt.lqg(plant), ProblemError, own),
            (lambda: lbt.robust(plant), ProblemError, own),
            (lambda: lbt.kalman(crowded), ProblemError, "6; got 7"),
            (lambda: failure_sets(tuple("abcdefg")), ProblemError, "got 7: a, b, c, d, e, f, g"),
        ]
    )


def test_a_mixed_filter_lies_between_the_two(sensors_config, sensors_design):
    plant = sensors_config.plant
    central, mixed = (make(plant, gamma_ratio=1.02) for make in (lbt.hinf, lbt.mixed))
    assert sensors_design.rms < mixed.rms < central.rms
    assert central.gamma < mixed.gamma <= mixed.gamma_requested * (1 + 1e-9)
    assert mixed.gamma == pytest.approx(mixed.gamma_requested, rel=1e-5)
    met = lbt.mixed(plant, gamma=1.01 * sensors_design.gamma)  # by the Kalman filter, too
    assert met.method == "kalman"
    assert met.rms == pytest.approx(sensors_design.rms, rel=1e-12)


def test_sensors_that_are_all_read_complete_the_central_filter():
    line = replace(sensor_loops.LINES[0], direction=(1,))
    plant = example_plant((FAST,), lines=[line], motions=MOTIONS[:1], modes=1)
    central, mixed = lbt.hinf(plant, gamma_ratio=1.1), lbt.mixed(plant, gamma_ratio=1.1, taps=4)
    assert mixed.solver.route == "youla"
    assert lbt.kalman(plant).rms < mixed.rms < central.rms
    assert len(mixed.fallbacks) == 7


def test_rows_are_what_runs_leave():
    plant, gains, fallbacks = designed((FAST, SLOW))
    rows = failure_rows(plant, gains, fallbacks)
    assert " ".join(row.missing for row in rows[:5]) == "wavefront truth m1 m2 wavefront + truth"
    for row, (missing, remaining) in zip(rows[:2], fallbacks.items(), strict=False):
        pairs = [(remaining, row.fallback_nm), (gains, row.zero_nm)][: 1 if row.must_switch else 2]
        for used, residual_nm in pairs:
            controller = plant.controller(used)
            left = sensor_loops.simulated_covariances(plant, controller, blind=missing)
            assert residual_nm == pytest.approx(np.sqrt(np.trace(sum(left))), rel=1e-7)
            assert row.fallback_nm <= residual_nm * (1 + 1e-9)
    # a reading that stays leaves an offset: a run for each independent part of the readings
    readings = model_covariances(failed_loop(plant, gains, ()), plant)[0, 2:, 2:]
    stuck = np.linalg.cholesky(readings).T
    still = np.zeros((400, len(stuck), 2)), np.zeros((400, *stuck.shape))
    for row, missing in zip(rows[:3], fallbacks, strict=False):
        facts = {"blind": missing, "stuck": stuck}
        left = sensor_loops.run_loop(plant, plant.controller(gains), *still, **facts)[-4:]
        expected = np.sqrt(row.zero_nm**2 + np.sum(left**2) / 4)
        assert row.zero_nm < row.frozen_nm == pytest.approx(expected, rel=1e-6)


def test_readings_are_residual_and_noise():
    plant, gains, _ = designed((FAST,))
    loop = failed_loop(plant, gains, ())
    covariances = model_covariances(loop, plant)
    left = residual_budget(loop, plant, frame_means=True).total_nm2
    np.testing.assert_allclose(covariances[:, :2, :2].mean(axis=0), left, rtol=1e-9)
    np.testing.assert_allclose(covariances[0, 2:4, 2:4], left + 75**2 * np.eye(2), rtol=1e-9)
    power = np.diag(FAST.noise_m_s2).copy()
    for line, motion in zip(plant.vibrations, plant.motions, strict=True):
        for i, channel in enumerate(FAST.channels):
            if channel in motion:
                facts = plant.hardware, FAST, motion[channel], line
                power[i] += np.sum(sensor_loops.acceleration(*facts)[1] ** 2)
    np.testing.assert_allclose(np.diag(covariances[0])[4:], power, rtol=1e-9)


def test_without_any_reading_the_mirror_stays():
    plant, _, fallbacks = designed((SLOW,))
    units = plant.hardware.suite.units
    *_, (missing, gains) = fallbacks.items()
    assert missing == units
    assert not gains.any()
    assert failed_loop(plant, gains, units).is_stable
    (row,) = failure_rows(plant, gains, {units: gains})
    powers = [model.rms_nm**2 for model in (*plant.vibrations, *plant.turbulence)]
    assert row.fallback_nm == pytest.approx(np.sqrt(sum(powers)), rel=1e-6)


def test_a_failure_that_must_be_seen():
    """The estimator of an unstable controller believes readings of zero."""
    rows = failure_rows(*designed((SLOW,), noise_nm=15))
    for row in rows:
        assert row.must_switch == (row.unseen_radius >= 1)
        assert (row.zero_nm is None) == (row.frozen_nm is None) == row.must_switch
        assert row.fallback_radius < 1
    assert [row.must_switch for row in rows] == [True, False, True]
