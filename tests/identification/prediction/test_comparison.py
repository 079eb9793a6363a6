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
    assert table["best integrator"].model_nm == exact.rms_nm
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


INTEGRATOR = lbt.integrator(PATH, gain=0.3)


def test_what_cannot_be_compared_is_refused():
    one = loop_record(GOOD[:, 0], frame_rate_hz=RATE, unit="nm")
    rows = [
        (partial(make_table, controllers={"best integrator": INTEGRATOR}), "may be called"),
        (partial(make_table, one), "2 modes at 800 Hz and 1 axes"),
        (partial(make_table, record_of(GOOD[:1], PATH)), "frames to fit and to test on; got 1"),
        (partial(make_table, GOOD), "expected a LoopRecord"),
        (partial(make_table, running=INTEGRATOR), "what ran needs commands"),
        (partial(make_table, imaging=2.2), "expected an Imaging"),
        (partial(make_table, plant=PATH), "expected a TipTiltPlant"),
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
