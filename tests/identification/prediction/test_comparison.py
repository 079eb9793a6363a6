"""Tables of controllers on data beside what the model promises, and the least-squares predictor."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.effort import count_calls
from support.predictions import (
    CAMERA,
    CASES,
    FLAT,
    GOOD,
    LINES,
    PATH,
    RATE,
    SLOW,
    SPOILT,
    STUCK,
    TILTED,
    a_plant,
    a_series,
    pseudo_open_loop,
)

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification import (
    least_squares_predictor,
    prediction_against_data,
    replayed_residual,
)
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
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
    frames, rng = 30_000, np.random.default_rng(6)
    total = [
        a_series(model, frames, rng) + a_series(line.ar_model(RATE), frames, rng)
        for model, line in zip(turbulence, LINES, strict=True)
    ]
    noise = rng.standard_normal((frames, 2)) * [15.0, 10.0]
    ran = lbt.integrator(plant.hardware, gain=0.25)
    loop = lbt.close_loop(plant.hardware, ran.controller)
    series = filter_series(loop.system, np.column_stack([*total, noise]))
    y, u = series[:, 4:], series[:, 2:4]
    return plant, ran, y, pseudo_open_loop(y, u, plant.hardware)


def test_the_table():
    plant, ran, y, z = two_different_axes()
    kalman, hinf = lbt.kalman(plant), lbt.hinf(plant, gamma_ratio=1.2, route="riccati")
    designs = {"Kalman": kalman, "H-infinity": hinf.controller}
    known = {"measurements": y, "running": ran, "imaging": CAMERA}
    table = prediction_against_data(plant, z, designs, **known)
    names = "what ran, best integrator, Kalman, H-infinity, least-squares predictor"
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
    row = table["least-squares predictor"].replayed  # which nothing that is causal can beat
    assert row.total_nm2 > limit.model_nm**2 - 4 * row.total_error_nm2
    # what ran: its own measurements on the same frames, and its replay is what it measured
    begin, end = table.test[0]
    assert (begin, end) == (15_000, 30_000)  # the first half is enough to warm up
    part = y[begin:end] / 0.6
    variance = np.mean(part**2, axis=0) - np.array([15.0, 10.0]) ** 2 / 0.36
    np.testing.assert_allclose(table["what ran"].replayed.variance_nm2, variance, rtol=1e-9)
    known = {"noise_nm": [15.0, 10.0], "test": [(begin, end)]}
    again = replayed_residual(z, ran.controller, plant.hardware, **known)
    np.testing.assert_allclose(again.measured_nm, part, rtol=0, atol=1e-7)
    gained, error = table["what ran"].replayed.above(table["Kalman"].replayed)
    assert gained > 4 * error
    assert table["Kalman"].replayed_nm == table["Kalman"].replayed.rms_nm
    best = lbt.design.model_integrator(plant)
    loop = lbt.close_loop(plant.hardware, best.controller)
    exact = lbt.residual_budget(loop, plant, frame_means=True)
    assert table["best integrator"].model_nm == exact.rms_nm
    unknown = prediction_against_data(plant, z, {}, measurements=y)["what ran"]
    assert unknown.model_axis_nm is None
    assert np.isnan([unknown.model_nm, unknown.ratio, unknown.deviations]).all()


def test_a_table_of_one_axis():
    line = lbt.Vibration(frequency_hz=20, damping=0.02, rms_nm=60, direction=(1,))
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=SLOW, vibrations=[line], noise_nm=15.5, modes=1
    )
    rng = np.random.default_rng(8)
    z = a_series(SLOW, 9000, rng) + a_series(line.ar_model(RATE), 9000, rng)
    z = (z + 15.5 * rng.standard_normal(z.size))[:, None]
    known = {"imaging": CAMERA, "stretches": [(0, 5000), (5100, 9000)]}
    table = prediction_against_data(plant, z, {"Kalman": lbt.kalman(plant)}, **known)
    assert table.fit == ((0, 4450),)
    assert table.test == ((4450, 5000), (5500, 9000))
    row = table["Kalman"]
    assert abs(row.deviations) < 4
    strehl = lbt.loop.jitter_strehl([[row.replayed_nm**2]], imaging=CAMERA)
    assert row.strehl == pytest.approx(strehl, rel=1e-12)


def test_a_wrong_model_is_found_out():
    """The model of a filter for another frequency promises what the data does not show."""
    plant, _, _, z = two_different_axes()
    wrong = retuned_plant(plant, 6.0)
    table = prediction_against_data(wrong, z, {"Kalman": lbt.kalman(wrong)})
    row, right = table["Kalman"], lbt.kalman(plant).rms
    assert row.deviations > 5
    assert row.model_nm < 1.05 * right < row.replayed_nm / 1.1
    assert table["least-squares predictor"].replayed_nm < row.replayed_nm


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
    table = prediction_against_data(plant, z, {})
    assert [entry.name for entry in table.entries] == ["best integrator", "least-squares predictor"]
    assert "no limit of performance: a limit needs modes that decouple" in table.notes[-1]


def test_the_noise_of_the_table_has_its_correlations():
    S, R = np.array([[1.0, 0.8], [0.3, 1.0]]), 100 * np.array([[1, -0.9], [-0.9, 1]])
    air, back, rng = process(0.99), np.linalg.inv(S), np.random.default_rng(0)
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=air, noise_nm=R, sensor_matrix=S)
    total = np.column_stack([a_series(air, 20_000, rng) for _ in range(2)])
    z = total + rng.multivariate_normal([0, 0], R, 20_000) @ back.T
    table = prediction_against_data(plant, z, {"Kalman": lbt.kalman(plant)})
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
    assert prediction_against_data(right, z, mine).notes == ()
    table = prediction_against_data(wrong, z, mine, measurements=z)
    (note,) = table.notes
    assert "of what ran, best integrator, mine, least-squares predictor: its variance is" in note
    assert "4 standard errors below zero" in note
    for entry in table.entries[:-1]:
        assert entry.replayed.refuted
        assert np.isnan(entry.replayed.upper_nm)


def textbook_regression(z, mirror_taps, taps, axis):
    """Return the rows of regressors of an axis, and the values that they predict."""
    m = len(mirror_taps)
    frames = range(m - 1 + taps, len(z))
    rows = [
        [
            sum(c * z[k - late - i, axis] for i, c in enumerate(mirror_taps))
            for late in range(1, taps + 1)
        ]
        for k in frames
    ]
    return np.array(rows), z[m - 1 + taps :, axis]


@pytest.mark.parametrize("delay", [1.0, 2.3])
def test_the_predictor_is_the_least_squares_of_a_textbook(delay):
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay)
    z = np.cumsum(np.random.default_rng(1).standard_normal((300, 2)), axis=0) @ TILTED
    stretches = [(0, 130), (140, 300)]
    _, coefficients = least_squares_predictor(z, path, taps=5, stretches=stretches)
    for i in range(2):
        parts = [textbook_regression(z[a:b], path.mirror_taps, 5, i) for a, b in stretches]
        X, wanted = (np.concatenate([part[j] for part in parts]) for j in (0, 1))
        expected, *_ = np.linalg.lstsq(X, wanted, rcond=None)
        np.testing.assert_allclose(coefficients[i], expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("delay", "gain", "mirror", "sensor"), CASES[1:])
def test_the_controller_of_the_predictor_gives_its_residual(delay, gain, mirror, sensor):
    """The loop around it leaves z less the FIR prediction: in a replay, to rounding."""
    base = a_plant(delay=delay, mirror=mirror, sensor=sensor).hardware
    path = replace(base, sensor_matrix=gain * base.sensor)
    z = np.cumsum(np.random.default_rng(4).standard_normal((1800, 2)), axis=0)
    controller, coefficients = least_squares_predictor(z, path, taps=7)
    commands, wanted = np.zeros_like(z), z.copy()
    for late in range(7):
        commands[late:] += z[: len(z) - late] * coefficients[:, late]
    for i, tap in enumerate(path.mirror_taps):
        wanted[1 + i :] -= tap * commands[: len(z) - 1 - i]
    residual = replayed_residual(z, controller, path, noise_nm=1.0)
    np.testing.assert_allclose(residual.measured_nm, wanted[400:], rtol=0, atol=1e-8)
    assert lbt.close_loop(path, controller).is_stable


def test_ar_processes_are_predicted_as_in_closed_form():
    """Two frames ahead: a1 x(k+1) + a2 x(k) with x(k+1) = a1 x(k) + a2 x(k-1)."""
    a1, a2 = 1.6, -0.8
    z = a_series(process(a1, a2, driving=1.0), 60_000, np.random.default_rng(0))[:, None]
    near = lbt.LoopHardware(frame_rate_hz=RATE, modes=1, delay_frames=1)  # Yule and Walker's
    for path, expected in ((ONE_MODE, [a1**2 + a2, a1 * a2, 0, 0]), (near, [a1, a2])):
        _, coefficients = least_squares_predictor(z, path, taps=len(expected))
        np.testing.assert_allclose(coefficients.ravel(), expected, rtol=0, atol=0.02)


def test_more_taps_come_to_the_limit_and_none_passes_it():
    """By the model, exactly: a predictor that was fitted to a long series, over its length."""
    line = lbt.Vibration(frequency_hz=40, damping=0.05, rms_nm=100, direction=(1,))
    air, rng = process(0.95, driving=20.0), np.random.default_rng(5)
    known = {"turbulence": air, "vibrations": [line], "noise_nm": 20.0, "modes": 1}
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, delay_frames=2.4, **known)
    z = a_series(air, 50_000, rng) + a_series(line.ar_model(RATE), 50_000, rng)
    z = (z + 20 * rng.standard_normal(z.size))[:, None]
    limit = least_model_residual(plant, frame_means=True).rms_nm
    ratios = []
    for taps in (1, 4, 16, 64):
        controller, _ = least_squares_predictor(z, plant.hardware, taps=taps)
        loop = lbt.close_loop(plant.hardware, controller)
        ratios.append(lbt.residual_budget(loop, plant, frame_means=True).rms_nm / limit)
    assert np.all(np.diff(ratios) < 0)
    assert ratios[0] > 1.2
    assert 1 < ratios[-1] < 1.01


def test_regressors_that_depend_on_each_other():
    """Two values of a pure sinusoid say all; the coefficients of least norm are taken."""
    z = 100 * np.sin(2 * np.pi * 20 / RATE * np.arange(3000))[:, None]
    controller, coefficients = least_squares_predictor(z, ONE_MODE, taps=32)
    X, wanted = textbook_regression(z, ONE_MODE.mirror_taps, 32, 0)
    expected = np.linalg.pinv(X, rcond=1e-9) @ wanted
    np.testing.assert_allclose(coefficients.ravel(), expected, rtol=0, atol=1e-9)
    assert np.sum(coefficients**2) < 1
    residual = replayed_residual(z, controller, ONE_MODE, noise_nm=0.0)
    assert np.max(np.abs(residual.measured_nm)) < 1e-9


def make_table(plant=None, controllers=None, **options):
    """Compare what is predicted with data, with changed arguments."""
    return prediction_against_data(plant or a_plant(), GOOD, controllers or {}, **options)


def fit_predictor(path=PATH, **options):
    return least_squares_predictor(GOOD, path, **options)


INTEGRATOR = lbt.integrator(PATH, gain=0.3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make_table(controllers={"best integrator": INTEGRATOR}), "may be called"),
        (lambda: make_table(measurements=GOOD[:1999]), "within 1999 frames"),
        (lambda: make_table(measurements=GOOD[:, :1]), r"measurements must be \(frames, 2\)"),
        (lambda: make_table(measurements=np.vstack([GOOD, GOOD])), "have the 2000 frames of open"),
        (lambda: make_table(measurements=SPOILT[::-1]), "measurements, frames 1000 to 2000, must"),
        (lambda: make_table(running=INTEGRATOR), "needs its measurements"),
        (lambda: make_table(imaging=2.2), "expected an Imaging"),
        (lambda: make_table(plant=PATH), "expected a TipTiltPlant"),
        (lambda: make_table()["mine"], "the table has the rows best integrator, .*'mine'"),
        (lambda: fit_predictor(taps=0), "taps must be at least 1"),
        (lambda: fit_predictor(taps=2.0), "taps must be an integer"),
        (lambda: fit_predictor(taps=1200), "for each of 1200 coefficients.*; got 799"),
        (lambda: fit_predictor(stretches=[(0, 20), (30, 50)]), "each of 32 coefficients.* got 0"),
        (lambda: fit_predictor(FLAT), "sensor matrix that can be inverted"),
        (lambda: fit_predictor(STUCK), r"influence matrix that can be .* got \(2, 2\) of rank 1"),
        (lambda: fit_predictor(a_plant()), "expected a LoopHardware"),
    ],
)
def test_what_cannot_be_compared_or_predicted_is_refused(call, message):
    with pytest.raises(ProblemError, match=message):
        call()


def test_a_controller_that_is_unstable_is_a_note():
    one = np.eye(2)
    wild = lbt.Controller(A=one, B=3 * one, C=one, D=0 * one, dt_s=1 / RATE)
    table = make_table(controllers={"mine": wild})
    assert "mine is unstable at the sensor gain of the model" in table.notes
    assert "mine" not in [row.name for row in table.entries]
