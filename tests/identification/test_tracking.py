"""The tracking controller in the loop: change-overs without a bump, a drift, failures."""

from functools import partial

import numpy as np
import pytest
from support.recorded_runs import recorded_run
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification import TrackingController
from lbt_synth.linear import estimator_form
from lbt_synth.loop.disturbances import draw_disturbance
from lbt_synth.models import ARModel, PositionLoop, SinusoidalVibration

AIR = ARModel(coefficients=[1.9975, -0.9976], driving_rms_nm=0.6, frame_rate_hz=800)
KNOWN = {"frame_rate_hz": 800, "turbulence": AIR, "noise_nm": 15.5}


def line(frequency_hz, damping=0.02, direction=(1,)):
    known = {"damping": damping, "rms_nm": 300, "direction": direction}
    return lbt.Vibration(frequency_hz=frequency_hz, **known)


def axis(frequency_hz, **changes):
    return lbt.tip_tilt_plant(**KNOWN, modes=1, vibrations=[line(frequency_hz)], **changes)


TWO_AXES = lbt.tip_tilt_plant(
    **KNOWN,
    delay_frames=1.4,
    vibrations=[line(20, direction=(1, 0.5))],
    sensor_matrix=np.diag([0.8, 1.1]),
    influence_matrix=[[1, 0.2], [0, 0.9]],
    mirror=PositionLoop.from_bandwidth(natural_frequency_hz=50, damping=0.5, bandwidth_hz=300),
)


def disturbed(plant, *, frames, hz=20):
    """Return total phase and noise, (1, frames, n) each; the vibration is on the first axis."""
    along = tuple(np.eye(plant.hardware.modes)[0])
    shake = SinusoidalVibration(frequency_hz=hz, rms_nm=300, direction=along)
    truth = lbt.Truth(turbulence=AIR, vibrations=(shake,), noise_nm=15.5)
    drawn = draw_disturbance(truth, plant.hardware, frames=frames, seed=0)
    return drawn.phase_nm, drawn.noise


def run(controller, plant, series):
    """Return residual, commands and measurements, (frames, n + m + q)."""
    return recorded_run(controller, plant.hardware, *series)[0]


def test_each_filter_is_as_if_it_had_always_run():
    """Its commands are those of its estimator, run beside the loop from the first frame on."""
    plant, made = TWO_AXES, []

    def design(problem):
        made.append(lbt.kalman(problem))
        return made[-1]

    tracker = TrackingController(plant, window_s=1.0, update_s=0.75, design=design)
    series = run(tracker, plant, disturbed(plant, frames=1600, hz=22))
    _, commands, measured = np.split(series, [2, 4], axis=1)
    assert [update.reason for update in tracker.history] == [""] * 2
    assert len({design.gain_predictor.tobytes() for design in made}) == 3
    scale, last = np.max(np.abs(commands)), np.vstack([0 * commands[:1], commands[:-1]])
    starts = [0, 800, 1400, 1600]  # a filter runs from the frame after its update on
    for number, filter_design in enumerate(made):
        ran = slice(*starts[number : number + 2])
        beside, cold = estimator_form(filter_design).start(), filter_design.controller.start()
        expected = np.array([beside.step(y, u) for y, u in zip(measured, last, strict=True)])
        np.testing.assert_allclose(commands[ran], expected[ran], rtol=0, atol=1e-9 * scale)
        if number:  # one that began here, from zero, would be far off
            away = [cold.step(y) for y in measured[ran][:20]] - commands[ran][:20]
            assert np.max(np.abs(away)) > 0.02 * scale


def test_a_line_that_moves_is_followed_and_a_fixed_filter_does_not():
    plant = axis(18)
    moves = {"frequency_hz": 18, "end_hz": 22, "duration_s": 4}
    drift = SinusoidalVibration(**moves, rms_nm=300, direction=(1,))
    truth = lbt.Truth(turbulence=AIR, vibrations=(drift,), noise_nm=15.5)
    tracker = TrackingController(plant, window_s=1, update_s=1)

    def residual(controller):
        settings = {"hardware": plant.hardware, "frames": 4800, "settle_frames": 800, "seed": 2}
        return lbt.simulate(controller, truth, **settings).residual_nm[0, :, 0]

    followed = residual(tracker)
    for update in tracker.history:
        assert update.reason == ""
        true = drift.frequency_hz_at(update.time_s - 1.5)  # settled, in the middle of the window
        assert min(abs(hz - true) for hz in update.frequencies_hz) < 0.1
    fixed, knowing = (residual(lbt.kalman(p).controller) for p in (plant, axis(22)))
    rms = [np.sqrt(np.mean(series[3200:] ** 2)) for series in (followed, fixed, knowing)]
    assert rms[0] < min(0.7 * rms[1], 1.1 * rms[2])
    assert np.max(np.abs(followed)) < 2 * np.max(np.abs(fixed))  # nor is there a bump


def test_a_filter_that_fails_never_runs():
    wrong = {
        "LinAlgError: Singular matrix": lambda _: np.linalg.inv(np.zeros((1, 1))),
        "must be stable with the new filter": lambda _: lbt.kalman(axis(20, sensor_gain=0.1)),
        "only filters of a TipTiltPlant": lambda p: lbt.integrator(p.hardware, gain=0.3),
    }
    plant, designs = axis(18), iter([lbt.kalman, *wrong.values()])
    settings = {"window_s": 0.75, "update_s": 0.25}
    tracker = TrackingController(plant, **settings, design=lambda problem: next(designs)(problem))
    series = disturbed(plant, frames=1000)
    tracked = run(tracker, plant, series)
    fixed = run(lbt.kalman(plant).controller.start(), plant, series)
    assert np.allclose(tracked, fixed, rtol=0, atol=1e-10 * np.max(np.abs(fixed)))
    for update, words in zip(tracker.history, wrong, strict=True):
        assert words in update.reason
        assert (update.frequencies_hz, update.rms_nm) == ((18.0,), (300.0,))
        assert update.noise_nm == (pytest.approx(15.5),)


def test_measurements_that_are_not_numbers_hold_the_command_and_spoil_a_window():
    plant = axis(20)
    tracker = TrackingController(plant, window_s=1.0, update_s=0.5)
    total, noise = disturbed(plant, frames=2400)
    clean = run(tracker, plant, (total[:, :500], noise[:, :500]))
    noise[0, [500, 501, 700], 0] = [np.nan, np.inf, -np.inf]
    noise[0, 1300:1320] = np.nan
    out = run(tracker, plant, (total, noise))
    assert out[500, 1] == out[501, 1] == out[499, 1]
    assert out[700, 1] == out[699, 1]
    assert np.array_equal(out[:500], clean)
    reasons = [update.reason for update in tracker.history]
    assert [bool(reason) for reason in reasons] == [False, False, True, True, False]
    assert "got 2.5 %" in reasons[2]


def test_a_new_line_on_the_other_axis_is_found():
    lines = (*TWO_AXES.vibrations, line(41, damping=0.01, direction=(0, 1)))
    tracker = TrackingController(TWO_AXES, window_s=4.0, update_s=4.0)
    shaken = lbt.Truth(turbulence=AIR, vibrations=lines, noise_nm=15.5)
    size = {"frames": 3200, "settle_frames": 0, "seed": 3}
    lbt.simulate(tracker, shaken, hardware=TWO_AXES.hardware, **size)
    (update,) = tracker.history
    assert min(abs(hz - 41) for hz in update.frequencies_hz) < 0.5


def test_what_cannot_be_tracked_is_refused():
    plant, tracker = axis(20), TrackingController(axis(20))
    coupled = axis(20, sensor_matrix=[[1.0], [0.5]])
    rows = [
        (plant, {"window_s": 0.5}, "window_s must be at least 0.64"),
        (plant, {"update_s": 0}, "update_s must be at least"),
        (plant, {"design": lambda p: lbt.integrator(p.hardware, gain=0.3)}, "only filters of"),
        (plant.hardware, {}, "expected a TipTiltPlant"),
        (coupled, {}, "each measurement must be of one axis"),
    ]
    require_refusals(
        (partial(TrackingController, tracked, **options), ProblemError, words)
        for tracked, options, words in rows
    )
    refused(lambda: tracker.step([0.0, 0.0]), DimensionError, r"y must have shape \(1,\)")
    assert np.array_equal(tracker.step([0]), [0.0])  # nothing was taken in
