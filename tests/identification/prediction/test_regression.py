"""Predictors of least squares, with and without accelerometers."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from support.recorded_loops import slanted_record
from support.refusals import refused
from support.structures import structure

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification import loop_record
from lbt_synth.identification.accelerometers.readings import channels_beside
from lbt_synth.identification.prediction import regression
from lbt_synth.identification.prediction.comparison import WITHOUT, compare_designs
from lbt_synth.identification.prediction.residual import replay
from lbt_synth.identification.records.record import keep_frames, split_halves
from lbt_synth.loop import close_loop


@cache
def vibrating():
    """A structure of three modes with three channels, the first half of a run and its model."""
    seen = structure(6, seconds=20, modes=(3, 3), channels=(3, 3))
    record = seen.record(0, len(seen.phase) // 2)
    return seen, record, lbt.identify(record, sensor_gain=1.0)


def beside_record():
    seen, record, _ = vibrating()
    return channels_beside(record, seen.readings[: record.frames])


@cache
def fitted():
    _, record, model = vibrating()
    return regression.regress(record, model, channels=beside_record())


@cache
def predictor(*, channels: bool):
    _, record, model = vibrating()
    return (fitted() if channels else regression.regress(record, model)).design()


def left_nm2(design, controller=None, *, silent: tuple[int, ...] = ()):
    """Return what a design leaves of the unseen half of the run, without noise."""
    seen, record, _ = vibrating()
    readings = seen.readings.copy()
    readings[:, list(silent)] = 0.0
    loop = close_loop(design.hardware, design.controller if controller is None else controller)
    z = seen.pseudo_open_loop
    error = seen.phase - (z - replay(loop, z, ((0, len(z)),), readings))
    return float(np.sum(np.mean(error[record.frames :] ** 2, axis=0)))


@pytest.mark.parametrize("runs", [((9, 60),), ((5, 40), (52, 97))])
def test_moments_are_those_of_the_products(runs) -> None:
    """Against the regressors written out, row by row."""
    rng = np.random.default_rng(0)
    signals, targets = rng.standard_normal((97, 3)), rng.standard_normal((97, 2))
    moments = regression.lagged_moments(signals, targets, runs, 5)
    frames = [k for start, stop in runs for k in range(start, stop)]
    rows = np.array([np.concatenate([signals[k - lag] for lag in range(5)]) for k in frames])
    wanted = targets[frames]
    np.testing.assert_allclose(moments.squares, rows.T @ rows, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(moments.products, rows.T @ wanted, rtol=1e-12, atol=1e-12)
    assert moments.frames == len(frames)
    b = rng.standard_normal((15, 2))
    left = np.sum((wanted - rows @ b) ** 2) / len(frames)
    assert moments.left(b) == pytest.approx(left, rel=1e-12)
    some = np.array([0, 3, 4])
    part = moments.chosen(some)
    np.testing.assert_array_equal(part.squares, moments.squares[np.ix_(some, some)])


def test_channels_that_see_a_structure_are_worth_what_is_claimed() -> None:
    """The claims are of the second half of the record; the judge is a run after it."""
    _, record, model = vibrating()
    alone, fused = (predictor(channels=channels) for channels in (False, True))
    base = left_nm2(lbt.kalman(model.plant()))
    assert left_nm2(alone) < 1.02 * base
    assert left_nm2(fused) < 0.6 * base
    assert fused.other_sensors == ("channel1", "channel2", "channel3")
    half = lbt.identify(split_halves(record)[0], sensor_gain=1.0)
    table, _ = compare_designs(record, half, {"predictor": {}}, channels=beside_record())
    title = "least-squares predictor"
    claimed_nm = table[title].replayed_nm
    assert claimed_nm**2 == pytest.approx(left_nm2(fused), rel=0.2)
    assert table[f"{title}{WITHOUT}"].replayed_nm ** 2 == pytest.approx(left_nm2(alone), rel=0.2)
    # without channels the fall-back leaves what the own sensor does
    (fallback,) = (k for missing, k in fused.controllers.items() if missing)
    assert left_nm2(fused, fallback, silent=(0, 1, 2)) == pytest.approx(left_nm2(alone), rel=0.05)
    # and what each is worth, by the moments of the unseen half alone
    for place, row in enumerate(regression.channel_values(record, half, beside_record())):
        assert row.channel == f"channel{place + 1}"
        assert row.without_nm > 0.98 * claimed_nm
        dead = np.sqrt(left_nm2(fused, silent=(place,)))
        assert row.dead_nm == pytest.approx(dead, rel=0.25)


def test_the_filter_gives_the_sum_of_squares_of_the_moments() -> None:
    """The loop, its reduction apart, leaves of the record what the regression says."""
    seen, record, model = vibrating()
    fit, design, runs = fitted(), predictor(channels=True), record.stretches()
    coefficients = fit.solve(range(len(fit.scales)), fit.penalty, fit.whole)
    loop = close_loop(design.hardware, design.controller)
    z = record.pseudo_open_loop(model.sensor_gains)
    left = replay(loop, z, runs, seen.readings[: record.frames])
    ((start, stop),) = runs
    first = start + round(record.frame_rate_hz / 2)
    measured = float(np.sum(np.mean(left[first:stop] ** 2, axis=0)))
    assert measured == pytest.approx(fit.whole.left(coefficients), rel=0.01)


def test_a_fit_adds_its_coefficients_over_the_frames() -> None:
    """None where a penalty holds them all at the model's; else what two halves lose to each other."""
    fit, kalman = fitted(), lbt.kalman(vibrating()[2].plant())
    assert fit.fit_share(1e30) == pytest.approx(0, abs=1e-9)
    assert left_nm2(fit.design(1e12)) == pytest.approx(left_nm2(kalman), rel=0.02)
    penalty, signals = 1e-6, range(len(fit.scales))
    past, later = (sum(parts[1:], parts[0]) for parts in (fit.parts[:3], fit.parts[3:]))
    first, second, whole = (fit.solve(signals, penalty, of) for of in (past, later, fit.whole))
    apart = later.left(first) - past.left(first) + past.left(second) - later.left(second)
    half = replace(fit, parts=fit.parts[:3]).fit_share(penalty)
    assert apart == pytest.approx(4 * half * fit.whole.left(whole), rel=0.3)
    assert 0 < predictor(channels=True).claims["fit_share"] < 0.1


def test_separate_axes_are_regressed_as_each_alone() -> None:
    """Against the record of each axis by itself, with the model of that axis."""
    record = slanted_record()
    mixed = lbt.identify(record, sensor_gain=1.0, most_lines=1)
    model, (line,) = mixed.separated(), mixed.shared
    joint = regression.regress(record, model, separate=True)
    both = joint.solve(range(4), 1e-4, joint.whole)
    shares, left_nm2 = [], joint.whole.targets
    for i, axis in enumerate(model.axes):
        (part,) = axis.parts
        assert part.direction is None
        assert part.rms_nm == pytest.approx(line.rms_nm * abs(line.direction[i]))
        series = {name: getattr(record, name)[:, [i]] for name in ("measurements", "commands")}
        facts = {"frame_rate_hz": record.frame_rate_hz, "delay_frames": 2, "unit": "nm"}
        alone = regression.regress(loop_record(**series, **facts), replace(model, axes=(axis,)))
        assert alone.whole.targets == pytest.approx(left_nm2[[i]])
        expected = alone.solve(range(2), 1e-4, alone.whole)[:, 0]
        assert both[joint.places([i, 2 + i]), i] == pytest.approx(expected, rel=1e-4, abs=1e-7)
        assert not both[joint.places([1 - i, 3 - i]), i].any()
        shares.append(alone.fit_share(1e-4))
    assert joint.fit_share(1e-4) == pytest.approx(np.average(shares, weights=left_nm2))
    couples = [regression.regress(record, mixed), joint]
    for one, reads in zip(couples, (True, False), strict=True):
        controller = one.design(1e-4).controller
        response = controller.to_statespace().frequency_response([20.0])[0]
        assert (np.abs(response[0, 1]) > 1e-3) == reads
        assert (response[0, 1] != 0) == reads


def test_more_noise_is_trusted_less() -> None:
    """The command of white noise falls, and the residual rises; it is phase that is added."""
    _, record, model = vibrating()
    more_nm = 8 * np.array([axis.noise_nm for axis in model.axes])
    calm = regression.regress(record, model, added_nm=more_nm).design()
    usual = predictor(channels=False)
    assert max(calm.claims["command_rms"]) < 0.8 * max(usual.claims["command_rms"])
    assert left_nm2(calm) > left_nm2(usual)
    pair = replace(model, axes=2 * (replace(model.axes[0], noise_nm=3.0, sensor_gain=2.0),))
    noisier = regression.noisier(pair, np.array([2.0, 0.0]))
    assert [axis.noise_nm for axis in noisier.axes] == pytest.approx([5.0, 3.0])


def test_gains_and_delays_that_are_not_whole() -> None:
    """While a command holds it leaves what the limit is, and no more than the model's filter."""
    line = lbt.Vibration(frequency_hz=40, damping=0.05, rms_nm=100, direction=(1,))
    fast = lbt.models.ARModel(coefficients=[0.95], driving_rms_nm=20.0, frame_rate_hz=1000)
    truth = lbt.Truth(turbulence=fast, vibrations=(line,), noise_nm=10.0, sensor_gain=0.6)
    path = lbt.LoopHardware(frame_rate_hz=1000, modes=1, delay_frames=2.4)
    ran = lbt.integrator(path, gain=0.3).controller
    run = lbt.simulate(ran, truth, hardware=path, frames=40_000, frame_means=True)
    known = {"frame_rate_hz": 1000, "delay_frames": 2.4, "unit": "nm"}
    record = loop_record(run.measurements[0], run.commands[0], **known)
    model = lbt.identify(record, sensor_gain=0.6)
    own, assumed = model.hardware, replace(truth, sensor_gain=1.0)
    exact = [
        lbt.residual_budget(close_loop(own, design), assumed).rms_nm
        for design in (lbt.kalman(model.plant()), regression.regress(record, model).design())
    ]
    limit = lbt.loop.least_residual(own, assumed).rms_nm
    assert limit < exact[1] < min(1.005 * limit, exact[0])


def test_what_is_too_short_or_dead_is_refused() -> None:
    _, record, model = vibrating()
    brief = keep_frames(record, np.arange(record.frames) < 900)
    words = f"needs {12 * regression.TAPS} frames beyond the first"
    refused(lambda: regression.regress(brief, model), ProblemError, words)
    beside = partial(channels_beside, record, np.zeros((500, 2)), ("a", "b"))
    refused(beside, ProblemError, "nothing but zeros or gaps in a, b. Leave them out")
