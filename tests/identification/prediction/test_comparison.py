"""The table of controllers on data beside what the model promises."""

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
    SPOILT,
    a_plant,
    a_series,
    a_truth,
    pseudo_open_loop,
)

import lbt_synth as lbt
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.models.plant.tip_tilt import retuned_plant


def test_on_held_out_data_no_predictor_beats_the_limit():
    plant = a_plant(gain=0.5)
    limit = lbt.kalman(plant).rms
    for seed in range(4):
        night = lbt.simulate(
            lbt.integrator(plant.hardware, gain=0.2).controller,
            a_truth(),
            hardware=plant.hardware,
            frames=12_000,
            seed=seed,
            settle_frames=0,
        )
        z = pseudo_open_loop(night.measurements[0], night.commands[0], plant.hardware)
        table = lbt.identification.prediction_against_data(plant, z, {}, taps=24)
        row = table["least-squares predictor"].replayed
        assert row.total_nm2 > limit**2 - 4 * row.total_error_nm2


def two_different_axes():
    turbulence = [
        lbt.models.ARModel(coefficients=[1.97, -0.972], driving_rms_nm=4.0, frame_rate_hz=RATE),
        lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=50.0, frame_rate_hz=RATE),
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=turbulence,
        vibrations=LINES,
        noise_nm=np.diag([15.0, 10.0]) ** 2,
        sensor_gain=0.6,
    )
    frames, rng = 30_000, np.random.default_rng(6)
    total = np.column_stack(
        [
            a_series(model, frames, rng) + a_series(line.ar_model(RATE), frames, rng)
            for model, line in zip(turbulence, LINES, strict=True)
        ]
    )
    noise = rng.standard_normal((frames, 2)) * [15.0, 10.0]
    ran = lbt.integrator(plant.hardware, gain=0.25)
    loop = lbt.close_loop(plant.hardware, ran.controller)
    series = filter_series(loop.system, np.hstack([total, noise]))
    y, u = series[:, 4:], series[:, 2:4]
    return plant, ran, y, pseudo_open_loop(y, u, plant.hardware)


def test_the_table():
    plant, ran, y, z = two_different_axes()
    kalman, hinf = lbt.kalman(plant), lbt.hinf(plant, gamma_ratio=1.2, route="riccati")
    given_ = {"Kalman": kalman, "H-infinity": hinf.controller}
    table = lbt.identification.prediction_against_data(
        plant, z, given_, measurements=y, running=ran, imaging=CAMERA
    )
    names = [entry.name for entry in table.entries]
    assert names == [
        "what ran",
        "best integrator",
        "Kalman",
        "H-infinity",
        "least-squares predictor",
        "limit of performance",
    ]
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
    # what ran: its own measurements on the same frames
    begin, end = table.test[0]
    assert (begin, end) == (15_000, 30_000)  # the first half is enough to warm up
    part = y[begin:end] / 0.6
    np.testing.assert_allclose(
        table["what ran"].replayed.variance_nm2,
        np.mean(part**2, axis=0) - np.array([15.0, 10.0]) ** 2 / 0.36,
        rtol=1e-9,
    )
    # and its replay is what it measured
    again = lbt.identification.replayed_residual(
        z,
        ran.controller,
        plant.hardware,
        noise_nm=[15.0, 10.0],
        test=[(begin, end)],
    )
    np.testing.assert_allclose(again.measured_nm, part, rtol=0, atol=1e-7)
    gained, error = table["what ran"].replayed.above(table["Kalman"].replayed)
    assert gained > 4 * error
    assert table["Kalman"].replayed_nm == table["Kalman"].replayed.rms_nm
    assert np.linalg.norm(limit.model_axis_nm) == pytest.approx(limit.model_nm)
    best = lbt.design.model_integrator(plant)
    loop = lbt.close_loop(plant.hardware, best.controller)
    exact = lbt.residual_budget(loop, plant, frame_means=True)
    assert table["best integrator"].model_nm == exact.rms_nm
    unknown = lbt.identification.prediction_against_data(plant, z, {}, measurements=y)["what ran"]
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
    table = lbt.identification.prediction_against_data(
        plant,
        z,
        {"Kalman": lbt.kalman(plant)},
        imaging=CAMERA,
        stretches=[(0, 5000), (5100, 9000)],
    )
    assert table.fit == ((0, 4450),)
    assert table.test == ((4450, 5000), (5500, 9000))
    row = table["Kalman"]
    assert abs(row.deviations) < 4
    assert row.strehl == pytest.approx(
        lbt.loop.jitter_strehl([[row.replayed_nm**2]], imaging=CAMERA), rel=1e-12
    )


def test_a_wrong_model_is_found_out():
    """A filter for another frequency: its model promises what the data does not show."""
    plant, _, _, z = two_different_axes()
    wrong = retuned_plant(plant, 6.0)
    table = lbt.identification.prediction_against_data(wrong, z, {"Kalman": lbt.kalman(wrong)})
    row, right = table["Kalman"], lbt.kalman(plant).rms
    assert row.deviations > 5
    assert row.model_nm < 1.05 * right < row.replayed_nm / 1.1
    assert table["least-squares predictor"].replayed_nm < table["Kalman"].replayed_nm


def test_replays_run_on_whole_series():
    plant, _, _, z = two_different_axes()
    controllers = [
        lbt.kalman(plant).controller,
        lbt.integrator(plant.hardware, gain=0.3).controller,
    ]
    for controller in controllers:
        calls = [
            count_calls(
                lbt.identification.replayed_residual,
                series,
                controller,
                plant.hardware,
                noise_nm=[15.0, 10.0],
            )
            for series in (z[: len(z) // 2], z)
        ]
        assert calls[1] < 1.2 * calls[0]
        assert calls[1] < len(z)  # no step of Python per frame


def test_a_limit_that_is_not_known_is_a_note():
    crossed = lbt.Vibration(frequency_hz=25, damping=0.01, rms_nm=50, direction=(1, 1))
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=SLOW,
        vibrations=[LINES[0], crossed],
        noise_nm=15.5,
        delay_frames=2.4,
    )
    z = np.random.default_rng(0).standard_normal((4000, 2)).cumsum(axis=0)
    table = lbt.identification.prediction_against_data(plant, z, {})
    assert [entry.name for entry in table.entries] == ["best integrator", "least-squares predictor"]
    assert "no limit of performance: a limit needs modes that decouple" in table.notes[0]


@pytest.mark.parametrize("correlation", [0.6, -0.9])
def test_the_noise_of_the_table_has_its_correlations(correlation):
    S, R = np.array([[1.0, 0.8], [0.3, 1.0]]), 100 * np.array([[1, correlation], [correlation, 1]])
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=5.0, frame_rate_hz=RATE)
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=slow, noise_nm=R, sensor_matrix=S)
    rng = np.random.default_rng(0)
    total = np.column_stack([a_series(slow, 20_000, rng) for _ in range(2)])
    z = total + rng.multivariate_normal([0, 0], R, 20_000) @ np.linalg.inv(S).T
    table = lbt.identification.prediction_against_data(plant, z, {"Kalman": lbt.kalman(plant)})
    assert abs(table["Kalman"].deviations) < 4
    assert 0.95 < table["Kalman"].ratio < 1.05
    back = np.linalg.inv(S)
    np.testing.assert_allclose(
        table["Kalman"].replayed.noise_nm2, back @ R @ back.T, rtol=0, atol=1e-9
    )
    assert table.notes == ()


def test_more_noise_than_the_data_has_is_a_note():
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=5.0, frame_rate_hz=RATE)
    rng = np.random.default_rng(0)
    z = (a_series(slow, 8000, rng) + 10 * rng.standard_normal(8000))[:, None]
    path = {"frame_rate_hz": RATE, "turbulence": slow, "modes": 1}
    right, wrong = (lbt.tip_tilt_plant(**path, noise_nm=s) for s in (10.0, 60.0))
    assert (
        lbt.identification.prediction_against_data(right, z, {"mine": lbt.kalman(right)}).notes
        == ()
    )
    table = lbt.identification.prediction_against_data(
        wrong, z, {"mine": lbt.kalman(right)}, measurements=z
    )
    (note,) = table.notes
    assert "of what ran, best integrator, mine, least-squares predictor: its variance is" in note
    assert "standard errors below zero" in note
    for entry in table.entries[:-1]:
        assert entry.replayed.refuted
        assert np.isnan(entry.replayed.upper_nm)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"controllers": {"best integrator": lbt.integrator(PATH, gain=0.3)}}, "may not be called"),
        ({"controllers": {1: lbt.integrator(PATH, gain=0.3)}}, "may not be called 1"),
        (
            {"controllers": {"mine": PATH}},
            "controller must be a Controller, or a design; got LoopHardware",
        ),
        ({"stretches": [(0, 2001)]}, "within 2000 frames"),
        ({"measurements": GOOD[:1999]}, "within 1999 frames"),
        ({"measurements": GOOD[:, :1]}, r"measurements must be \(frames, 2\)"),
        ({"measurements": np.vstack([GOOD, GOOD])}, "must have the 2000 frames of open_loop"),
        ({"measurements": SPOILT[::-1]}, "measurements, frames 1000 to 2000, must be finite"),
        ({"running": lbt.integrator(PATH, gain=0.3)}, "needs its measurements"),
        ({"imaging": 2.2}, "expected an Imaging"),
        ({"noise_error_nm": -1.0}, "noise_error_nm must be at least 0"),
        ({"taps": 300}, "at least 1200 frames to fit"),
    ],
)
def test_tables_that_are_refused(more, message):
    arguments = {"controllers": {}} | more
    with pytest.raises(lbt.errors.ProblemError, match=message):
        lbt.identification.prediction_against_data(a_plant(), GOOD, **arguments)


def test_tables_of_what_does_not_hold():
    wild = lbt.Controller(
        A=np.eye(2), B=3 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=1 / RATE
    )
    with pytest.raises(lbt.errors.UnstableLoopError, match="mine: the closed loop must be stable"):
        lbt.identification.prediction_against_data(a_plant(), GOOD, {"mine": wild})
    with pytest.raises(lbt.errors.ProblemError, match="expected a TipTiltPlant"):
        lbt.identification.prediction_against_data(PATH, GOOD, {})
    table = lbt.identification.prediction_against_data(a_plant(), GOOD, {})
    with pytest.raises(
        lbt.errors.ProblemError, match="the table has the rows best integrator, .*'mine'"
    ):
        table["mine"]
