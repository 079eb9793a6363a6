"""Controllers replayed on recorded data, against runs under the truth, and tables of them."""

from dataclasses import replace
from functools import cache, partial

import league
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.diagnoses import line_record
from support.effort import count_calls
from support.predictions import (
    CAMERA,
    GOOD,
    LINES,
    PATH,
    RATE,
    SHELL,
    SLOW,
    TILTED,
    a_plant,
    a_series,
    a_truth,
    pseudo_open_loop,
    record_of,
    replayed_residual,
)
from support.refusals import require_refusals
from support.sensor_loops import example_plant

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification import loop_record, prediction_against_data
from lbt_synth.identification.prediction.residual import estimate_residual, settled_test
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.models import ARModel
from lbt_synth.models.plant.tip_tilt import retuned_plant

ONE_MODE = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
INTEGRATOR = lbt.integrator(PATH, gain=0.3).controller


def idle(modes):
    """Return a controller that does nothing."""
    zero = np.zeros((modes, modes))
    return lbt.Controller(A=0.0, B=zero[:1], C=zero[:, :1], D=zero, dt_s=1 / RATE)


def test_the_standard_errors_are_those_of_many_nights():
    """Correlated axes, coloured residuals, two stretches: errors per axis, in total, and paired."""
    rng, nights = np.random.default_rng(7), 300
    stretches, rows = ((0, 700), (900, 1500)), np.r_[0:700, 900:1500]
    noise, mixing = np.diag([1.0, 4.0]), np.array([[1.0, 0.0], [0.8, 0.6]])
    model = ARModel(coefficients=[0.9], driving_rms_nm=1.0, frame_rate_hz=RATE)
    known = {"noise_nm2": noise, "noise_error_nm4": np.zeros((2, 2))}
    # of x and of y = 0.4 x, both with the same noise
    exact = np.array([1, 0.16])[:, None, None] * mixing @ mixing.T * model.rms_nm**2
    seen, errors = np.zeros((2, nights, 4))  # of x: each axis and both; and of x above y
    for night in range(nights):
        x = np.column_stack([a_series(model, 1500, rng, 200) for _ in range(2)]) @ mixing.T
        w = rng.standard_normal((1500, 2)) @ np.sqrt(noise)
        one, other = (
            estimate_residual((part * x + w)[rows], stretches, **known) for part in (1.0, 0.4)
        )
        seen[night, :3] = *one.variance_nm2, one.total_nm2
        errors[night, :3] = *np.sqrt(np.diag(one.error_nm4)), one.total_error_nm2
        seen[night, 3], errors[night, 3] = one.above(other)
    backwards, error = other.above(one)
    assert (backwards, error) == (-seen[-1, 3], pytest.approx(errors[-1, 3], rel=1e-12))
    wanted = np.array([*np.diag(exact[0]), np.trace(exact[0]), np.trace(exact[0] - exact[1])])
    scatter, errors = np.std(seen, axis=0), np.sqrt(np.mean(np.square(errors), axis=0))
    # 300 nights know their scatter to 4 %, and their mean to scatter / 17
    np.testing.assert_allclose(scatter, errors, rtol=0.15)
    assert np.all(np.abs(np.mean(seen, axis=0) - wanted) < 4 * scatter / np.sqrt(nights))
    # without the correlation of the axes the error of the total would be too small
    assert errors[2] > 1.1 * np.hypot(errors[0], errors[1])


def test_the_noise_of_coupled_sensors_has_common_errors():
    """The noise is subtracted with each deviation a little larger, one at a time."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[1, 0.9], [0.9, 1]])
    z = 100 * np.random.default_rng(0).standard_normal((1000, 2))
    noise, error = np.array([10.0, 8.0]), np.array([1.0, 0.5])

    def estimate(noise_nm, error_nm=0.0):
        known = {"noise_nm": noise_nm, "noise_error_nm": error_nm}
        return replayed_residual(z, INTEGRATOR, path, **known)

    added = estimate(noise, error).error_nm4 - estimate(noise).error_nm4
    steps = 0.01 * np.eye(2)
    rise = [estimate(noise + h).variance_nm2 - estimate(noise - h).variance_nm2 for h in steps]
    slope = np.transpose(rise) / 0.02
    np.testing.assert_allclose(added, slope @ np.diag(error**2) @ slope.T, rtol=1e-6)
    # 2 s ds through the squares of the inverse, on both axes at once
    squares = np.linalg.inv(path.sensor) ** 2
    total = np.linalg.norm(np.sum(squares, axis=0) * 2 * noise * error)
    assert np.sqrt(np.sum(added)) == pytest.approx(total, rel=1e-9)
    assert total > 1.3 * np.sqrt(np.trace(added))


def test_a_residual_far_below_zero_refutes_the_noise():
    z = 10 * np.random.default_rng(0).standard_normal((4000, 1))
    shown, right, wrong = (
        replayed_residual(z, idle(1), ONE_MODE, noise_nm=noise_nm) for noise_nm in (7.0, 10.0, 12.0)
    )
    assert (right.refuted, wrong.refuted) == (False, True)
    assert np.isfinite(right.upper_nm)
    assert shown.text == f"{shown.rms_nm:.3g} +- {shown.rms_error_nm:.2g} nm"
    assert right.text == f"at most {right.upper_nm:.3g} nm (the noise hides it)"
    assert "more noise than the data" in wrong.text
    assert 0 < shown.strehl(CAMERA) <= 1
    assert np.isnan([one.strehl(CAMERA) for one in (right, wrong)]).all()
    assert (shown.safe_nm2, right.safe_nm2) == (shown.total_nm2, pytest.approx(right.upper_nm**2))
    below = -wrong.total_nm2 / wrong.total_error_nm2
    assert below == pytest.approx(44 * np.sqrt(3600 / 2) / 100, rel=0.1)
    assert np.isnan([wrong.upper_nm, wrong.rms_nm, wrong.rms_error_nm]).all()
    # one axis is enough
    both = replayed_residual(np.column_stack([z, 10 * z]), idle(2), PATH, noise_nm=12.0)
    assert both.total_nm2 > 0
    assert both.refuted


def test_a_residual_below_its_noise_is_not_cut_off():
    signs = []
    for seed in range(10):
        z = 10 * np.random.default_rng(seed).standard_normal((800, 2))
        found = replayed_residual(z, idle(2), PATH, noise_nm=10.0)
        exact = np.sum(np.mean(z[400:] ** 2, axis=0)) - 200
        assert found.total_nm2 == pytest.approx(exact, abs=1e-9)
        assert abs(found.total_nm2) < 5 * found.total_error_nm2
        signs.append(negative := found.total_nm2 < 0)
        assert np.isnan(found.rms_nm) == np.isnan(found.rms_error_nm) == negative
        upper = max(found.total_nm2 + 2 * found.total_error_nm2, 0)
        assert found.upper_nm**2 == pytest.approx(upper)
    assert 1 < sum(signs) < 9  # there is nothing: either sign


@pytest.mark.parametrize(
    ("delay", "gain", "mirror", "sensor", "method"),
    [
        (1.0, 0.6, None, None, "integrator"),
        (2.4, 0.5, None, None, "lqg"),
        (2.25, 0.8, SHELL, TILTED, "lqg"),
        (3.0, 1.3, SHELL, None, "integrator"),
    ],
)
def test_a_replay_is_the_run_that_there_would_have_been(delay, gain, mirror, sensor, method):
    """Residual and noise are those of a run, once both have forgotten where they began."""
    plant = a_plant(delay=delay, mirror=mirror, sensor=sensor, gain=gain)
    path = plant.hardware
    ran = lbt.integrator(path, gain=0.15).controller
    design = lbt.lqg(plant) if method == "lqg" else lbt.integrator(path, gain=0.25)
    truth, size = a_truth(gain), {"hardware": path, "frames": 2400, "seed": 3, "settle_frames": 0}
    night = lbt.simulate(ran, truth, **size)
    would = lbt.simulate(design.controller.start(), truth, **size)  # stepped frame by frame
    assert np.array_equal(night.total_nm, would.total_nm)
    z = pseudo_open_loop(night.measurements[0], night.commands[0], path, gain)
    sensed, back = gain * path.sensor, np.linalg.inv(gain * path.sensor)
    known = {"noise_nm": 15.5, "test": [(2000, 2400)]}
    found = replayed_residual(z, design.controller, replace(path, sensor_matrix=sensed), **known)
    measured = would.measurements[0, 2000:]
    wanted = measured @ back.T
    exact = {"rtol": 0, "atol": 1e-9 * (scale := np.max(np.abs(wanted)))}
    np.testing.assert_allclose(found.measured_nm, wanted, **exact)
    np.testing.assert_allclose(found.noise_nm2, 15.5**2 * back @ back.T)
    # and that residual is the phase of the frame before, with its noise
    phase = would.residual_nm[0, 1999:-1]
    noise = (measured - phase @ sensed.T) @ back.T
    np.testing.assert_allclose(found.measured_nm, phase + noise, **exact)
    covariance = wanted.T @ wanted / 400 - 15.5**2 * back @ back.T
    np.testing.assert_allclose(found.covariance_nm2, covariance, rtol=0, atol=1e-9 * scale**2)


@settings(max_examples=10)
@given(
    st.integers(0, 2**31),
    st.floats(1e-3, 1e3),
    st.integers(0, 300),
    st.sampled_from([1.0, 1.7, 2.0, 2.5]),
)
def test_scale_and_beginning(seed, scale, start, delay):
    """A replay is linear, and begins with its stretch: what lies outside is not read."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay)
    new = lbt.integrator(path, gain=0.3).controller
    z = np.random.default_rng(seed).standard_normal((1200, 2))
    one = replayed_residual(z[start:], new, path, noise_nm=0.1)
    torn = np.full_like(z, np.nan)
    torn[start:] = scale * z[start:]
    known = {"noise_nm": 0.1 * scale, "stretches": [(start, 1200)]}
    other = replayed_residual(torn, new, path, **known)
    assert other.stretches == ((start + 400, 1200),)
    square, check = scale**2, np.testing.assert_allclose
    check(other.measured_nm, scale * one.measured_nm, rtol=0, atol=1e-12 * scale)
    check(other.covariance_nm2, square * one.covariance_nm2, rtol=1e-9, atol=1e-9 * square)
    assert other.total_error_nm2 == pytest.approx(square * one.total_error_nm2, rel=1e-9)


def test_a_constant_needs_no_warming_up():
    """However slow the loop is, a replay begins in its equilibrium."""
    path = a_plant().hardware
    z = 1e6 + np.random.default_rng(0).standard_normal((5000, 2))
    for new in (lbt.integrator(path, gain=2e-5), lbt.kalman(a_plant())):
        found, without = (
            replayed_residual(series, new.controller, path, noise_nm=0.0) for series in (z, z - 1e6)
        )
        rejection = lbt.close_loop(path, new.controller).path("phase", "residual")
        constant = rejection.frequency_response([0.0])[0]
        residual = found.measured_nm - 1e6 * np.sum(constant.real, axis=1)
        assert found.stretches == without.stretches
        np.testing.assert_allclose(residual, without.measured_nm, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("runs", "test", "kept"),
    [
        ([(0, 4000)], [(2000, 4000)], [(2000, 4000)]),
        ([(0, 4000)], [(100, 3000)], [(400, 3000)]),
        ([(0, 900), (950, 4000)], [(500, 900), (950, 3000)], [(500, 900), (1350, 3000)]),
        ([(0, 900), (950, 1300), (1400, 4000)], [(950, 1300), (1600, 4000)], [(1800, 4000)]),
    ],
)
def test_the_first_half_second_of_a_stretch_does_not_count(runs, test, kept):
    assert settled_test(tuple(runs), tuple(test), ONE_MODE) == tuple(kept)


def test_the_future_changes_nothing_before_it():
    """Nor does what a replay begins with: it runs over the frames before the test."""
    z = np.random.default_rng(0).standard_normal((3000, 2)).cumsum(axis=0)
    later = z + np.where(np.arange(3000) < 2600, 0.0, 1000.0)[:, None]
    known = {"noise_nm": 1.0, "stretches": [(10, 3000)], "test": [(1500, 3000)]}
    new = lbt.kalman(a_plant()).controller
    one, other = (replayed_residual(x, new, PATH, **known).measured_nm for x in (z, later))
    assert np.array_equal(one[:1100], other[:1100])
    assert np.max(np.abs(one[1100:] - other[1100:])) > 500


def replayed(series=GOOD, path=PATH, **options):
    return replayed_residual(series, INTEGRATOR, path, **({"noise_nm": 1.0} | options))


def test_what_cannot_be_replayed_is_refused():
    later = replayed(test=[(500, 2000)])
    rows = [
        (partial(replayed, noise_error_nm=-0.1), "noise_error_nm must be at least 0"),
        (partial(replayed, noise_error_nm=[1, 2, 3]), r"or one per measurement \(2\); got 3"),
        (partial(replayed, test=[(1950, 2000)]), "at least 400 frames beyond the first 400 .* 50"),
        (lambda: replayed().above(later), "on the same frames only"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)


def test_the_league_of_designs_and_rivals(monkeypatch, capsys):
    """The script of the benchmarks ranks a filter of the model above the best integrator."""
    names = ("best integrator", "least squares, 32 taps", "Kalman")
    entries = {name: league.ENTRIES[name] for name in names}
    monkeypatch.setattr(league, "ENTRIES", entries)
    night = line_record()
    brief = replace(night, measured=np.arange(night.frames) < 600)
    league.play({"night": night, "brief": brief}, 2)
    failure, _, heading, *rows = capsys.readouterr().out.splitlines()
    assert failure.startswith("brief is not in the table: ")
    assert heading.split()[-1] == "night"
    assert [row[:26].strip() for row in rows] == ["Kalman", "least squares, 32 taps", names[0]]
    assert float(rows[0].split()[-1]) == 0.0
    assert float(rows[2].split()[-1]) > 20


R = np.array([[225.0, -90.0], [-90.0, 100.0]])  # covariance of the noise [nm^2]


def process(*coefficients, driving=5.0):
    return ARModel(coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=RATE)


@cache
def two_different_axes():
    turbulence = [process(1.97, -0.972, driving=4.0), process(0.9886, driving=50.0)]
    known = {"turbulence": turbulence, "vibrations": LINES, "noise_nm": R, "sensor_gain": 0.6}
    plant, rng = lbt.tip_tilt_plant(frame_rate_hz=RATE, **known), np.random.default_rng(6)
    total = [
        a_series(model, 20_000, rng) + a_series(line.ar_model(RATE), 20_000, rng)
        for model, line in zip(turbulence, LINES, strict=True)
    ]
    noise = rng.multivariate_normal([0, 0], R, 20_000)
    ran = lbt.integrator(plant.hardware, gain=0.25)
    loop = lbt.close_loop(plant.hardware, ran.controller)
    series = filter_series(loop.system, np.column_stack([*total, noise]))
    y, u = series[:, 4:], series[:, 2:4]
    record = loop_record(y, u, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    return plant, ran, record, pseudo_open_loop(y, u, plant.hardware)


def test_the_table():
    plant, ran, record, z = two_different_axes()
    kalman, hinf = lbt.kalman(plant), lbt.hinf(plant, gamma_ratio=1.2, route="riccati")
    designs = {"Kalman": kalman, "H-infinity": hinf.controller}
    table = prediction_against_data(record, plant, designs, running=ran, imaging=CAMERA)
    names = "what ran, best integrator, Kalman, H-infinity"
    assert [entry.name for entry in table.entries] == [*names.split(", "), "limit of performance"]
    assert table.notes == ()
    for entry in table.entries[:-1]:
        assert abs(entry.deviations) < 4, entry.name
        assert 0.8 < entry.ratio < 1.2
        assert entry.replayed.stretches == table.test
        assert entry.strehl == pytest.approx(entry.model_strehl, abs=0.1)
        assert entry.strehl == pytest.approx(lbt.strehl(entry.replayed.covariance_nm2, CAMERA))
        np.testing.assert_allclose(entry.replayed.noise_nm2, R / 0.36, rtol=1e-12)
    assert table["Kalman"].model_nm == pytest.approx(kalman.rms, rel=1e-9)
    assert table["H-infinity"].model_nm == pytest.approx(hinf.rms, rel=1e-9)
    limit = table["limit of performance"]
    assert limit.model_nm == pytest.approx(kalman.rms, rel=1e-9)
    np.testing.assert_allclose(limit.model_axis_nm, kalman.certificate.rms_per_output, rtol=1e-9)
    assert (limit.replayed, limit.replayed_nm is np.nan) == (None, True)
    assert np.isnan([limit.ratio, limit.deviations, limit.strehl]).all()
    row = table["Kalman"].replayed  # which nothing that is causal can beat
    assert row.total_nm2 > limit.model_nm**2 - 4 * row.total_error_nm2
    # what ran: its own measurements on the same frames, and its replay is what it measured
    begin, end = table.test[0]
    assert (begin, end) == (10_001, 20_000)  # the first half is enough to warm up
    part = record.measurements[begin:end] / 0.6
    variance = np.mean(part**2, axis=0) - np.diag(R) / 0.36
    np.testing.assert_allclose(table["what ran"].replayed.variance_nm2, variance, rtol=1e-9)
    known = {"noise_nm": [15.0, 10.0], "test": [(begin, end)]}
    again = replayed_residual(z, ran.controller, plant.hardware, **known)
    np.testing.assert_allclose(again.measured_nm, part, rtol=0, atol=1e-7)
    gained, error = table["what ran"].replayed.above(table["Kalman"].replayed)
    assert gained > 4 * error
    assert table["Kalman"].replayed_nm == table["Kalman"].replayed.rms_nm
    best = lbt.close_loop(plant.hardware, lbt.integrator(plant.hardware, truth=plant).controller)
    exact = lbt.residual_budget(best, plant, frame_means=True)
    assert table["best integrator"].model_nm == pytest.approx(exact.rms_nm, rel=1e-9)
    unknown = prediction_against_data(record, plant, {})["what ran"]
    assert unknown.model_axis_nm is None
    assert np.isnan([unknown.model_nm, unknown.ratio, unknown.deviations]).all()


def test_a_wrong_model_is_found_out():
    """The model of a filter for another frequency promises what the data does not show."""
    plant, _, record, _ = two_different_axes()
    wrong = retuned_plant(plant, 6.0)
    table = prediction_against_data(record, wrong, {"Kalman": lbt.kalman(wrong)})
    row, right = table["Kalman"], lbt.kalman(plant).rms
    assert row.deviations > 5
    assert row.model_nm < 1.05 * right < row.replayed_nm / 1.1


def test_replays_run_on_whole_series():
    plant, _, _, z = two_different_axes()
    controller = lbt.kalman(plant).controller
    half, full = (
        count_calls(replayed_residual, series, controller, plant.hardware, noise_nm=[15.0, 10.0])
        for series in (z[: len(z) // 2], z)
    )
    assert full < 1.2 * half
    assert full < len(z)  # no step of Python per frame


def test_more_noise_than_the_data_has_is_a_note():
    """On the one axis of a loop that did nothing, with a gap in its test."""
    air, rng = process(0.99), np.random.default_rng(0)
    z = a_series(air, 8000, rng) + 10 * rng.standard_normal(8000)
    z[5000:5100] = np.nan
    idle = loop_record(z, np.zeros(8000), frame_rate_hz=RATE, delay_frames=2, unit="nm")
    plants = [
        lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=air, modes=1, noise_nm=noise_nm)
        for noise_nm in (10.0, 60.0)
    ]
    mine = {"mine": lbt.kalman(plants[0])}
    right, wrong = (prediction_against_data(idle, plant, mine) for plant in plants)
    assert right.notes == ()
    assert (right.fit, right.test) == (((2, 3951),), ((3951, 5000), (5500, 8000)))
    (note,) = wrong.notes
    assert "of what ran, best integrator, mine: its variance is" in note
    assert "4 standard errors below zero" in note
    for entry in wrong.entries[:-1]:
        assert entry.replayed.refuted
        assert np.isnan(entry.replayed.upper_nm)


def make_table(record=None, plant=None, controllers=None, **options):
    """Compare what is predicted with data, with changed arguments."""
    seen = record_of(GOOD, PATH) if record is None else record
    return prediction_against_data(seen, plant or a_plant(), controllers or {}, **options)


def test_what_cannot_be_compared_is_refused():
    one = loop_record(GOOD[:, 0], frame_rate_hz=RATE, unit="nm")
    rows = [
        (partial(make_table, controllers={"best integrator": INTEGRATOR}), "may be called"),
        (partial(make_table, one), "2 modes at 800 Hz and 1 axes"),
        (partial(make_table, GOOD), "expected a LoopRecord"),
        (partial(make_table, running=INTEGRATOR), "what ran needs commands"),
        (partial(make_table, imaging=2.2), "expected an Imaging"),
        (partial(make_table, plant=PATH), "expected a TipTiltPlant"),
        (partial(make_table, plant=example_plant()), "reads the loop's own sensor alone"),
        (partial(make_table, plant=a_plant(sensor=[[1, 0], [1, 0]])), "inverted; .* of rank 1"),
        (lambda: make_table()["mine"], "the table has the rows best integrator, .*'mine'"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)


def test_what_is_not_in_the_table_is_a_note():
    crossed = lbt.Vibration(frequency_hz=25, damping=0.01, rms_nm=50, direction=(1, 1))
    known = {"turbulence": SLOW, "vibrations": [LINES[0], crossed], "noise_nm": 15.5}
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, delay_frames=2.4, **known)
    one = np.eye(2)
    wild = lbt.Controller(A=one, B=3 * one, C=one, D=0 * one, dt_s=1 / RATE)
    table = make_table(record_of(GOOD, plant.hardware), plant, {"mine": wild})
    assert [row.name for row in table.entries] == ["best integrator"]
    assert "mine is unstable at the sensor gain of the model" in table.notes
    assert "no limit of performance: a limit needs modes that decouple" in table.notes[-1]
