"""Loops in which sensors fail, against runs in which they read zero."""

import numpy as np
import pytest
from support.sensor_loops import (
    FAST,
    SLOW,
    acceleration,
    example_plant,
    run_loop,
    simulated_covariances,
)

from lbt_synth.design.fallbacks import (
    failed_loop,
    failure_rows,
    failure_sets,
    make_fallbacks,
)
from lbt_synth.errors import ProblemError
from lbt_synth.linear import kalman_riccati
from lbt_synth.loop.budget import model_readings, residual_budget


def test_every_set_of_sensors_may_fail():
    assert failure_sets(("a", "b", "c")) == [
        ("a",),
        ("b",),
        ("c",),
        ("a", "b"),
        ("a", "c"),
        ("b", "c"),
        ("a", "b", "c"),
    ]
    with pytest.raises(ProblemError, match="there may be 6; got 7: a, b, c, d, e, f, g"):
        failure_sets(tuple("abcdefg"))


def test_rows_are_what_runs_leave():
    plant = example_plant((FAST, SLOW))
    gains, fallbacks = kalman_riccati(plant).gain_predictor, make_fallbacks(plant)
    rows = failure_rows(plant, gains, fallbacks)
    assert " ".join(row.missing for row in rows[:5]) == "wavefront truth m1 m2 wavefront + truth"
    for row, fallback in zip(rows[:4], fallbacks, strict=False):
        pairs = [(fallback.gains, row.fallback_nm)]
        if not row.must_switch:
            pairs.append((gains, row.zero_nm))
        for used, residual_nm in pairs:
            left = simulated_covariances(plant, plant.controller(used), blind=fallback.missing)
            assert residual_nm == pytest.approx(np.sqrt(np.trace(sum(left))), rel=1e-7)
            assert row.fallback_nm <= residual_nm * (1 + 1e-9)


def test_a_reading_that_stays_leaves_an_offset():
    plant = example_plant((FAST, SLOW))
    gains, fallbacks = kalman_riccati(plant).gain_predictor, make_fallbacks(plant)
    controller = plant.controller(gains)
    readings = model_readings(failed_loop(plant, gains, ()), plant)
    for row, fallback in list(zip(failure_rows(plant, gains, fallbacks), fallbacks, strict=True))[
        :5
    ]:
        # a run for each independent part of the readings, without any disturbance
        stuck = np.linalg.cholesky(readings).T
        still = np.zeros((400, len(stuck), 2)), np.zeros((400, *stuck.shape))
        left = run_loop(plant, controller, *still, blind=fallback.missing, stuck=stuck)[-4:]
        expected = np.sqrt(row.zero_nm**2 + np.sum(left**2) / 4)
        assert row.frozen_nm == pytest.approx(expected, rel=1e-6)
        assert row.frozen_nm > row.zero_nm


def test_readings_are_residual_and_noise():
    plant = example_plant((FAST,))
    loop = failed_loop(plant, kalman_riccati(plant).gain_predictor, ())
    readings = model_readings(loop, plant)
    left = residual_budget(loop, plant, frame_means=True).total_nm2
    np.testing.assert_allclose(readings[:2, :2], left + 75**2 * np.eye(2), rtol=1e-9)
    power = np.diag(FAST.noise_m_s2).copy()
    for line, motion in zip(plant.vibrations, plant.motions, strict=True):
        for i, channel in enumerate(FAST.channels):
            if channel in motion:
                _, read = acceleration(plant.hardware, FAST, motion[channel], line)
                power[i] += np.sum(read**2)
    np.testing.assert_allclose(np.diag(readings)[2:], power, rtol=1e-9)


def gains_without(plant, *missing):
    """The gains of the fall-back filter without some sensors."""
    return next(each.gains for each in make_fallbacks(plant) if each.missing == missing)


def test_what_is_missing_is_not_used():
    plant = example_plant((FAST, SLOW))
    gains = gains_without(plant, "truth", "m1")
    marked = plant.hardware.suite.marked(("m1", "truth"), plant.hardware)
    assert not gains[:, :, marked].any()
    assert gains[:, :, ~marked].any()
    alone = example_plant((FAST,))  # nothing but the other sensors
    assert gains_without(plant, "truth")[0][: alone.n_states, :2] == pytest.approx(
        kalman_riccati(alone).gain_predictor[:, :2], rel=1e-7, abs=1e-9
    )


def test_without_any_reading_the_mirror_stays():
    plant = example_plant((SLOW,))
    gains = gains_without(plant, *plant.hardware.suite.units)
    assert not gains.any()
    loop = failed_loop(plant, gains, plant.hardware.suite.units)
    assert loop.is_stable
    row = failure_rows(plant, gains, make_fallbacks(plant)[-1:])[0]
    powers = [line.rms_nm**2 for line in plant.vibrations]
    powers += [model.rms_nm**2 for model in plant.turbulence]
    assert row.fallback_nm == pytest.approx(np.sqrt(sum(powers)), rel=1e-6)


def test_a_failure_that_must_be_seen():
    # the estimator of an unstable controller believes readings of zero
    plant = example_plant((SLOW,), noise_nm=15)
    rows = failure_rows(plant, kalman_riccati(plant).gain_predictor, make_fallbacks(plant))
    for row in rows:
        assert row.must_switch == (row.unseen_radius >= 1)
        assert (row.zero_nm is None) == (row.frozen_nm is None) == row.must_switch
        assert row.fallback_radius < 1
    assert [row.must_switch for row in rows] == [True, False, True]
