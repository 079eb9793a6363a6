"""Certified filters of several sensors: claims that are refused, and sensors that fail."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.refusals import require_refusals
from support.sensor_loops import (
    AIR,
    FAST,
    LINES,
    MOTIONS,
    RATE_HZ,
    SLOW,
    acceleration,
    example_plant,
    run_loop,
    simulated_covariances,
)

import lbt_synth as lbt
from lbt_synth.design.filter_design import failed_loop, failure_rows, failure_sets, make_fallbacks
from lbt_synth.errors import InfeasibleError, ProblemError
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop.budget import model_covariances, residual_budget
from lbt_synth.models import Accelerometer, SensorSuite, WavefrontSensor

NORMS = {
    "estimation error, rms, against the one claimed",
    "estimation error, H-infinity norm, against the one claimed",
}
BOUND = "norm of the estimation error over its bound, less 1"
PROOF = "infeasible level over the level proved, less 1"


@cache
def designed(sensors, **changes):
    """Return a plant, the gains of its least variance, and its fall-backs."""
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


def failed_claims(design, **claims):
    """Return the names of the checks that fail if a design claims something else."""
    return failed(design, claims={**design.claims, **claims})


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
    triple = failed(kalman, gain_predictor=3 * kalman.gain_predictor)
    assert "spectral radius of the filter over a period" in triple
    fallbacks = kalman.fallbacks
    first, *_, last = fallbacks
    for gains in (1.001 * fallbacks[first], kalman.gain_predictor):
        names = failed(kalman, fallbacks={**fallbacks, first: gains})
        assert names == {"distance from the least-variance gains of any fall-back"}
    assert failed(kalman, fallbacks={**fallbacks, last: 1e-3 * kalman.gain_predictor})
    pairs = list(fallbacks.items())
    for some in (pairs[1:], pairs[::-1]):
        names = failed(kalman, fallbacks=dict(some))
        assert names == {"sets of failed sensors without a fall-back"}
    diverging = {**fallbacks, first: 20 * fallbacks[first]}
    assert "spectral radius of any loop with sensors missing" in failed(kalman, fallbacks=diverging)


def test_an_hinf_filter(hinf):
    assert hinf.certificate.passed
    assert hinf.gamma_requested == pytest.approx(1.1 * hinf.gamma_least)
    assert hinf.gamma_least < hinf.gamma < hinf.gamma_requested
    kalman = lbt.kalman(hinf.problem)
    assert kalman.rms < hinf.rms
    assert hinf.gamma < kalman.gamma
    same = lbt.hinf(hinf.problem, gamma=hinf.gamma_requested)
    assert same.gain_predictor == pytest.approx(hinf.gain_predictor)
    least = lbt.hinf(hinf.problem, route="riccati")
    assert least.gamma == pytest.approx(least.gamma_least, rel=1e-6)
    assert least.gamma_least == pytest.approx(hinf.gamma_least, rel=1e-6)


def test_claims_of_an_hinf_filter_that_are_wrong(hinf):
    least = hinf.gamma_least
    assert hinf.gamma_infeasible == pytest.approx(least, rel=1e-6)
    for factor in (0.9, 1.1):
        names = failed_claims(hinf, gamma_least=factor * least)
        assert names == {"least norm of any filter, error"}
    assert failed_claims(hinf, gamma_infeasible=1.001 * least) == {PROOF}
    low = "level proved over the infeasible level, less 1"
    assert failed_claims(hinf, gamma_infeasible=0.9 * least) == {low}
    assert failed(hinf, witness=None) == {PROOF}
    distance = "distance from its Riccati filter, or of the norm from its bound"
    assert failed_claims(hinf, gamma_requested=0.99 * hinf.gamma) == {BOUND, distance}
    gain = lbt.kalman(hinf.problem).gain_predictor
    assert failed(hinf, gain_predictor=gain) == {BOUND, *NORMS}


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
    many = Accelerometer(
        name="many", rate_hz=1000, delay_frames=2, channels=tuple("abcdef"), noise_m_s2=1e-3
    )
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
    line = replace(LINES[0], direction=(1,))
    known = {"frame_rate_hz": RATE_HZ, "turbulence": AIR, "vibrations": [line], "modes": 1}
    own = lbt.tip_tilt_plant(**known, noise_nm=75)
    plant = own.with_sensors(SensorSuite(sensors=(FAST,)), MOTIONS[:1])
    central, mixed = lbt.hinf(plant, gamma_ratio=1.1), lbt.mixed(plant, gamma_ratio=1.1, taps=4)
    assert mixed.solver.route == "youla"
    assert lbt.kalman(plant).rms < mixed.rms < central.rms
    assert len(mixed.fallbacks) == 7


def test_rows_are_what_runs_leave():
    plant, gains, fallbacks = designed((FAST, SLOW))
    rows = failure_rows(plant, gains, fallbacks)
    assert " ".join(row.missing for row in rows[:5]) == "wavefront truth m1 m2 wavefront + truth"
    for row, (missing, remaining) in zip(rows[:2], fallbacks.items(), strict=False):
        pairs = [(remaining, row.fallback_nm)]
        if not row.must_switch:
            pairs.append((gains, row.zero_nm))
        for used, residual_nm in pairs:
            left = simulated_covariances(plant, plant.controller(used), blind=missing)
            assert residual_nm == pytest.approx(np.sqrt(np.trace(sum(left))), rel=1e-7)
            assert row.fallback_nm <= residual_nm * (1 + 1e-9)
    # a reading that stays leaves an offset: a run for each independent part of the readings
    readings = model_covariances(failed_loop(plant, gains, ()), plant)[0, 2:, 2:]
    stuck = np.linalg.cholesky(readings).T
    still = np.zeros((400, len(stuck), 2)), np.zeros((400, *stuck.shape))
    for row, missing in zip(rows[:3], fallbacks, strict=False):
        known = {"blind": missing, "stuck": stuck}
        left = run_loop(plant, plant.controller(gains), *still, **known)[-4:]
        expected = np.sqrt(row.zero_nm**2 + np.sum(left**2) / 4)
        assert row.frozen_nm == pytest.approx(expected, rel=1e-6)
        assert row.frozen_nm > row.zero_nm


def test_readings_are_residual_and_noise():
    plant, gains, _ = designed((FAST,))
    loop = failed_loop(plant, gains, ())
    covariances = model_covariances(loop, plant)
    readings = covariances[0, 2:, 2:]
    left = residual_budget(loop, plant, frame_means=True).total_nm2
    np.testing.assert_allclose(covariances[:, :2, :2].mean(axis=0), left, rtol=1e-9)
    np.testing.assert_allclose(readings[:2, :2], left + 75**2 * np.eye(2), rtol=1e-9)
    power = np.diag(FAST.noise_m_s2).copy()
    for line, motion in zip(plant.vibrations, plant.motions, strict=True):
        for i, channel in enumerate(FAST.channels):
            if channel in motion:
                _, read = acceleration(plant.hardware, FAST, motion[channel], line)
                power[i] += np.sum(read**2)
    np.testing.assert_allclose(np.diag(readings)[2:], power, rtol=1e-9)


def test_without_any_reading_the_mirror_stays():
    plant, _, fallbacks = designed((SLOW,))
    units = plant.hardware.suite.units
    assert list(fallbacks)[-1] == units
    gains = fallbacks[units]
    assert not gains.any()
    assert failed_loop(plant, gains, units).is_stable
    row = failure_rows(plant, gains, {units: gains})[0]
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
