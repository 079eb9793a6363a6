"""Predictors as designs: filters of readings, reduced, certified and stored."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.predictors import BASE, HEARING, PATH, coefficients, made, readings
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.design import predictor
from lbt_synth.design.predictor import reduce_filter, regression_filter
from lbt_synth.errors import CertificateError, ProblemError
from lbt_synth.loop.closed_loop import youla_controller


def stepped(controller: lbt.Controller, series: np.ndarray) -> np.ndarray:
    run = controller.start()
    return np.array([run.step(row) for row in series])


def test_a_parameter_undoes_its_controller() -> None:
    back = youla_controller(PATH, youla_controller(PATH, BASE, sign=-1.0))
    first, second = (stepped(k, readings(frames=50)[:, :2]) for k in (BASE, back))
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-12)


def test_the_filter_is_the_sum_that_the_coefficients_say() -> None:
    """In the time domain: base, its past corrections, past measurements and channels."""
    b, series = coefficients(7), readings(frames=60)
    commands = stepped(regression_filter(PATH, BASE, b), series)
    base = stepped(youla_controller(PATH, BASE, sign=-1.0), series[:, :2])
    z = series[:, :2] @ np.linalg.inv(PATH.sensor).T
    signals, wanted = np.hstack([base, z, series[:, 2:]]), base.copy()
    for lag, weights in enumerate(b):
        wanted[lag:] += signals[: len(series) - lag] @ weights.T
    np.testing.assert_allclose(commands, wanted, rtol=0, atol=1e-10)


def test_any_stable_filter_makes_a_stable_loop_and_channels_move_no_pole() -> None:
    design = made()
    loop = design.close(HEARING)
    alone = loop.feedback()
    assert loop.is_stable
    assert (loop.reads_others, alone.reads_others) == (True, False)
    assert alone.spectral_radius == pytest.approx(loop.spectral_radius, rel=1e-9)
    gains, margins = (
        lbt.loop.stable_sensor_gains(HEARING, design.controller),
        lbt.loop_margins(loop),
    )
    assert (margins.gain_low, margins.gain_high) == pytest.approx(gains)


def test_a_reduced_filter_loses_little() -> None:
    long = regression_filter(PATH, BASE, coefficients(7, taps=60) * 0.2)
    short, lost_nm = reduce_filter(long, readings(), 4.0)
    assert short.n_states < long.n_states
    difference = stepped(long, readings(frames=2000)) - stepped(short, readings(frames=2000))
    apart = float(np.sum(np.mean(difference**2, axis=0)))
    assert apart == pytest.approx(lost_nm**2, rel=0.2)
    assert apart < 5e-3 * 4.0
    same, nothing = reduce_filter(long, readings(), 1e-12)
    assert (same is long, nothing) == (True, 0.0)


def test_noise_of_readings_is_that_of_a_run() -> None:
    design, rng = made(), np.random.default_rng(5)
    whites = (rng.standard_normal((20_000, 1)) * np.eye(5)[reading] for reading in range(5))
    commands = np.array([stepped(design.parameters[0], white) for white in whites])
    drawn = np.sqrt(np.sum(np.var(commands, axis=1), axis=1))
    assert predictor.command_rms(design.parameters)[:5] == pytest.approx(drawn, rel=0.03)
    (table,) = design.tables()
    assert [row.reading for row in table.rows] == ["wavefront 1", "wavefront 2", "a", "b", "c"]


@pytest.mark.parametrize("name", ["A", "B", "C"])
@pytest.mark.parametrize("place", [0, 1])
def test_sabotage_is_seen(name: str, place: int) -> None:
    """Each array of each filter times 1.001, and the claim itself."""
    design = made()
    assert design.recertify().passed
    parts = list(design.parameters)
    parts[place] = replace(parts[place], **{name: 1.001 * getattr(parts[place], name)})
    assert not replace(design, parameters=tuple(parts)).recertify().passed
    claims = design.claims | {"command_rms": tuple(1.001 * np.array(design.claims["command_rms"]))}
    with pytest.raises(CertificateError, match="command of white readings"):
        replace(design, claims=claims).recertify().require()


def test_gain_files_hold_it(tmp_path) -> None:
    design = made(residual_nm=12.0, residual_error_nm=0.5, alone_nm=20.0)
    again = lbt.load_gain(lbt.save_gain(tmp_path / "p.fits", design))
    assert (again.claims, again.expected_residual_nm) == (design.claims, 12.0)
    assert again.controllers.keys() == {frozenset(), frozenset({"a", "b", "c"})}
    for one, two in zip(design.controllers.values(), again.controllers.values(), strict=True):
        np.testing.assert_array_equal(one.A, two.A)


def test_a_channel_that_fails_takes_the_fallback_without_a_jump() -> None:
    """Of the applied commands both filters know the same: the residual stays that of one of them."""
    design = made()
    run = design.controller.start(design.controllers)
    run.miss({"a"})
    fallback = design.controllers[frozenset({"a", "b", "c"})].start()
    for row in readings(frames=20):
        np.testing.assert_array_equal(run.step(row), fallback.step(row))
    with pytest.raises(ProblemError, match="no filter without wavefront"):
        run.miss({"wavefront"})


def test_a_predictor_needs_a_record(config) -> None:
    what = {"groups": [[0, 1]], "what": "test"}
    single = partial(predictor.predictor_design, HEARING, [BASE], readings(), 1.0, **what)
    refused(single, ProblemError, "one filter, and a fall-back")
    design = partial(config.design, "predictor")
    refused(design, ProblemError, "the method predictor is made of a record")
