"""Tables of controllers on data beside what the model promises."""

from functools import cache, partial

import numpy as np
import pytest
from support.effort import count_calls
from support.predictions import (
    CAMERA,
    GOOD,
    LINES,
    PATH,
    RATE,
    SLOW,
    a_plant,
    a_series,
    pseudo_open_loop,
    record_of,
    replayed_residual,
)
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification import loop_record, prediction_against_data
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.models import ARModel
from lbt_synth.models.plant.tip_tilt import retuned_plant

ONE_MODE = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)


def process(*coefficients, driving=5.0):
    return ARModel(coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=RATE)


@cache
def two_different_axes():
    turbulence = [process(1.97, -0.972, driving=4.0), process(0.9886, driving=50.0)]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=turbulence,
        vibrations=LINES,
        noise_nm=np.diag([15.0, 10.0]) ** 2,
        sensor_gain=0.6,
    )
    frames, rng = 20_000, np.random.default_rng(6)
    total = [
        a_series(model, frames, rng) + a_series(line.ar_model(RATE), frames, rng)
        for model, line in zip(turbulence, LINES, strict=True)
    ]
    noise = rng.standard_normal((frames, 2)) * [15.0, 10.0]
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
    variance = np.mean(part**2, axis=0) - np.array([15.0, 10.0]) ** 2 / 0.36
    np.testing.assert_allclose(table["what ran"].replayed.variance_nm2, variance, rtol=1e-9)
    known = {"noise_nm": [15.0, 10.0], "test": [(begin, end)]}
    again = replayed_residual(z, ran.controller, plant.hardware, **known)
    np.testing.assert_allclose(again.measured_nm, part, rtol=0, atol=1e-7)
    gained, error = table["what ran"].replayed.above(table["Kalman"].replayed)
    assert gained > 4 * error
    assert table["Kalman"].replayed_nm == table["Kalman"].replayed.rms_nm
    best = lbt.integrator(plant.hardware, truth=plant)
    loop = lbt.close_loop(plant.hardware, best.controller)
    exact = lbt.residual_budget(loop, plant, frame_means=True)
    assert table["best integrator"].model_nm == pytest.approx(exact.rms_nm, rel=1e-9)
    unknown = prediction_against_data(record, plant, {})["what ran"]
    assert unknown.model_axis_nm is None
    assert np.isnan([unknown.model_nm, unknown.ratio, unknown.deviations]).all()


def test_a_table_of_one_axis():
    line = lbt.Vibration(frequency_hz=20, damping=0.02, rms_nm=60, direction=(1,))
    known = {"frame_rate_hz": RATE, "turbulence": SLOW, "noise_nm": 15.5, "modes": 1}
    plant, rng = lbt.tip_tilt_plant(**known, vibrations=[line]), np.random.default_rng(8)
    z = a_series(SLOW, 9000, rng) + a_series(line.ar_model(RATE), 9000, rng)
    z = (z + 15.5 * rng.standard_normal(z.size))[:, None]
    record = record_of(z, plant.hardware, measured=np.arange(9000) // 100 != 50)
    table = prediction_against_data(record, plant, {"Kalman": lbt.kalman(plant)}, imaging=CAMERA)
    assert table.fit == ((0, 4450),)
    assert table.test == ((4450, 5000), (5500, 9000))
    row = table["Kalman"]
    assert abs(row.deviations) < 4
    strehl = lbt.strehl([[row.replayed_nm**2]], CAMERA)
    assert row.strehl == pytest.approx(strehl, rel=1e-12)


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


def test_a_limit_that_is_not_known_is_a_note():
    crossed = lbt.Vibration(frequency_hz=25, damping=0.01, rms_nm=50, direction=(1, 1))
    known = {"turbulence": SLOW, "vibrations": [LINES[0], crossed], "noise_nm": 15.5}
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, delay_frames=2.4, **known)
    z = np.random.default_rng(0).standard_normal((4000, 2)).cumsum(axis=0)
    record = record_of(z, plant.hardware)
    table = prediction_against_data(record, plant, {})
    assert [entry.name for entry in table.entries] == ["best integrator"]
    assert "no limit of performance: a limit needs modes that decouple" in table.notes[-1]


def test_the_noise_of_the_table_has_its_correlations():
    S, R = np.array([[1.0, 0.8], [0.3, 1.0]]), 100 * np.array([[1, -0.9], [-0.9, 1]])
    air, back, rng = process(0.99), np.linalg.inv(S), np.random.default_rng(0)
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=air, noise_nm=R, sensor_matrix=S)
    total = np.column_stack([a_series(air, 20_000, rng) for _ in range(2)])
    z = total + rng.multivariate_normal([0, 0], R, 20_000) @ back.T
    record = record_of(z, plant.hardware)
    table = prediction_against_data(record, plant, {"Kalman": lbt.kalman(plant)})
    row = table["Kalman"]
    assert abs(row.deviations) < 4
    assert 0.95 < row.ratio < 1.05
    np.testing.assert_allclose(row.replayed.noise_nm2, back @ R @ back.T, rtol=0, atol=1e-9)
    assert table.notes == ()


def test_more_noise_than_the_data_has_is_a_note():
    air, rng = process(0.99), np.random.default_rng(0)
    z = (a_series(air, 8000, rng) + 10 * rng.standard_normal(8000))[:, None]
    path = {"frame_rate_hz": RATE, "turbulence": air, "modes": 1}
    right, wrong = (lbt.tip_tilt_plant(**path, noise_nm=s) for s in (10.0, 60.0))
    mine = {"mine": lbt.kalman(right)}
    idle = loop_record(z, 0 * z, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    assert prediction_against_data(idle, right, mine).notes == ()
    table = prediction_against_data(idle, wrong, mine)
    (note,) = table.notes
    assert "of what ran, best integrator, mine: its variance is" in note
    assert "4 standard errors below zero" in note
    for entry in table.entries[:-1]:
        assert entry.replayed.refuted
        assert np.isnan(entry.replayed.upper_nm)


def make_table(record=None, plant=None, controllers=None, **options):
    """Compare what is predicted with data, with changed arguments."""
    seen = record_of(GOOD, PATH) if record is None else record
    return prediction_against_data(seen, plant or a_plant(), controllers or {}, **options)


INTEGRATOR = lbt.integrator(PATH, gain=0.3)


def test_what_cannot_be_compared_is_refused():
    one, brief = record_of(GOOD[:, :1], ONE_MODE), record_of(GOOD[:1], PATH)
    rows = [
        (partial(make_table, controllers={"best integrator": INTEGRATOR}), "may be called"),
        (partial(make_table, one), "2 modes at 800 Hz and 1 axes"),
        (partial(make_table, brief), "frames to fit and to test on; got 1"),
        (partial(make_table, GOOD), "expected a LoopRecord"),
        (partial(make_table, running=INTEGRATOR), "what ran needs commands"),
        (partial(make_table, imaging=2.2), "expected an Imaging"),
        (partial(make_table, plant=PATH), "expected a TipTiltPlant"),
        (partial(make_table, plant=a_plant(sensor=[[1, 0], [1, 0]])), "inverted; .* of rank 1"),
        (lambda: make_table()["mine"], "the table has the rows best integrator, .*'mine'"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)


def test_a_controller_that_is_unstable_is_a_note():
    one = np.eye(2)
    wild = lbt.Controller(A=one, B=3 * one, C=one, D=0 * one, dt_s=1 / RATE)
    table = make_table(controllers={"mine": wild})
    assert "mine is unstable at the sensor gain of the model" in table.notes
    assert "mine" not in [row.name for row in table.entries]
