"""Lines followed in the pseudo-open loop, alone and beside neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.tracking import AIR, axis, line, sensed, simulated

import lbt_synth as lbt
from lbt_synth.loop.simulation.disturbances import draw_disturbance, draw_noise


def test_the_whole_model_is_found_in_a_window():
    """Two axes with other lines, noises and gains than the plant believes."""
    believed = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=AIR,
        noise_nm=10,
        vibrations=[replace(line(20), direction=(1, 0))],
    )
    gains, noises, lines_hz = (0.7, 1.0), (12.0, 25.0), (23.0, 41.0)
    true = [
        replace(line(hz, damping=0.01), direction=tuple(np.eye(2)[i]))
        for i, hz in enumerate(lines_hz)
    ]
    path = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=np.diag(gains))
    truth = lbt.Truth(turbulence=AIR, vibrations=true, noise_nm=list(noises))
    loop = lbt.simulate(
        lbt.integrator(path, gain=0.5).controller, truth, hardware=path, frames=8000, seed=3
    )
    y, u = loop.measurements[0, 2:], loop.commands[0, :-2]
    identify = lbt.identification.LoopIdentifier(believed)
    for _ in range(2):  # from nothing, and from what it was
        found = identify(y, u)
        assert np.allclose(np.diag(found.hardware.sensor), gains, rtol=0.12)
        assert np.allclose(np.sqrt(np.diag(found.R)), noises, rtol=0.05)
        for v in true:
            along = [w for w in found.vibrations if w.direction == v.direction]
            assert min(abs(w.frequency_hz - v.frequency_hz) for w in along) < 0.5
    assert lbt.kalman(found).certificate.passed
    # one more than the plant's on the axis that has most, or as many as are asked for
    three = lbt.simulate(
        lbt.integrator(path, gain=0.5).controller,
        replace(truth, vibrations=(*true, *(replace(true[0], frequency_hz=hz) for hz in (12, 60)))),
        hardware=path,
        frames=8000,
        seed=3,
    )
    y3, u3 = three.measurements[0, 2:], three.commands[0, :-2]
    for most, expected in ((None, 2), (1, 1), (3, 3)):
        made = lbt.identification.LoopIdentifier(believed, most_lines=most)(y3, u3)
        assert sum(v.direction == (1, 0) for v in made.vibrations) == expected
    given = lbt.identification.LoopIdentifier(believed, find_gain=False, most_lines=1)(y, u)
    assert np.array_equal(given.hardware.sensor, believed.hardware.sensor)


def test_wrong_identifiers_are_refused():
    plant = axis(20)
    with pytest.raises(lbt.errors.ProblemError, match="each measurement must be of one axis"):
        lbt.identification.LoopIdentifier(sensed(None))
    with pytest.raises(lbt.errors.ProblemError, match="expected a TipTiltPlant"):
        lbt.identification.LoopIdentifier(None)
    with pytest.raises(lbt.errors.ProblemError, match="most_lines must be at least 0"):
        lbt.identification.LoopIdentifier(plant, most_lines=-1)
    identify = lbt.identification.LoopIdentifier(plant)
    with pytest.raises(lbt.errors.DimensionError, match=r"must be \(frames, 1\)"):
        identify(np.zeros((3200, 1)), np.zeros((3200, 2)))
    # a window that is too short is noted in the history of the tracker
    tracker = lbt.identification.TrackingController(plant, window_s=0.25)
    simulated(tracker, frames=400)
    assert tracker.kept == len(tracker.history) > 0
    assert "at least 512 frames" in tracker.history[0].reason


# The follower.
def test_lines_are_found_in_the_pseudo_open_loop():
    """Two axes with a line each, along other directions than the axes, seen by three sensors."""
    lines = [
        lbt.Vibration(frequency_hz=18, damping=0.01, rms_nm=200, direction=(1, 1)),
        lbt.Vibration(frequency_hz=31, damping=0.01, rms_nm=150, direction=(1, -1)),
    ]
    sensor = np.array([[1, 0.1], [0.2, 0.9], [0.3, -0.4]])
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=AIR, noise_nm=15.5, vibrations=lines, sensor_matrix=sensor
    )
    true = [replace(v, frequency_hz=v.frequency_hz + 1.3) for v in lines]
    truth = lbt.Truth(turbulence=AIR, noise_nm=15.5, vibrations=true)
    rng = np.random.default_rng(0)
    size = {"frames": 3200, "cases": 12, "rng": rng}
    total, noise = (
        draw_disturbance(truth, plant.hardware, **size),
        draw_noise(truth, plant.hardware, **size),
    )
    corrections = 500 * rng.standard_normal(total.shape)  # whatever the loop did
    follow, errors = lbt.identification.LineFollower(plant), []
    for k in range(12):
        follow.reset()
        found = follow((total - corrections)[k] @ sensor.T + noise[k], corrections[k])
        errors.append(
            [a.frequency_hz - b.frequency_hz for a, b in zip(found.vibrations, true, strict=True)]
        )
        assert [v.rms_nm for v in found.vibrations] == [v.rms_nm for v in lines]
        assert np.array_equal(found.hardware.sensor, sensor)
    # in four seconds a resonance wanders by a part of its width, sqrt(k f / (2 pi 4 s)) and more
    assert np.all(np.std(errors, axis=0) < 0.3)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4 * np.std(errors, axis=0) / np.sqrt(12))


def neighbours(frequencies_hz, second=(1, 0)):
    lines = [
        lbt.Vibration(frequency_hz=hz, damping=0.01, rms_nm=100, direction=along)
        for hz, along in zip(frequencies_hz, [(1, 0), second], strict=True)
    ]
    return lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=AIR, noise_nm=15.5, vibrations=lines)


def sinusoids(*parts, seed, axis=0, frames=3200):
    rng, time_s = np.random.default_rng(seed), np.arange(frames) / 800
    series = 15.5 * rng.standard_normal((frames, 2))
    for hz, amplitude_nm in parts:
        phase = rng.uniform(0, 2 * np.pi)
        series[:, axis] += amplitude_nm * np.sin(2 * np.pi * hz * time_s + phase)
    return series


@pytest.mark.parametrize(
    ("frames", "parts"),
    [
        (3200, [(21.6, 140), (23.6, 300)]),
        (3200, [(21.6, 300), (23.6, 140)]),
        (3200, [(20.3, 140), (22.3, 140)]),
        (3200, [(18.6, 140), (20.6, 300)]),
        (3200, [(20.5, 140), (21.7, 140)]),
        (3200, [(19, 800), (23, 100)]),
        (1600, [(20.3, 140), (22.3, 140)]),
    ],
)
def test_neighbours_are_found_each_at_its_own_peak(frames, parts):
    for order in (1, -1):
        follow = lbt.identification.LineFollower(neighbours([20, 22][::order]))
        for seed in range(2):
            follow.reset()
            series = sinusoids(*parts, seed=seed, frames=frames)
            found = follow(series, np.zeros_like(series))
            wanted = [hz for hz, _ in parts][::order]
            assert [v.frequency_hz for v in found.vibrations] == pytest.approx(wanted, abs=0.06)


@pytest.mark.parametrize(
    "parts",
    [
        [(21, 400)],
        [(21, 4000)],
        [(21, 40)],
        [(20, 140)],
        [(19.3, 1000)],
        [(20.9, 300), (21.2, 300)],  # closer than the window resolves
    ],
)
def test_two_lines_are_not_found_on_one_peak(parts):
    follow = lbt.identification.LineFollower(neighbours([20, 22]))
    for seed in range(3):
        series = sinusoids(*parts, seed=seed)
        assert follow(series, np.zeros_like(series)) is None


def test_lines_along_other_directions_are_no_neighbours():
    plant = neighbours([20, 22], second=(0, 1))
    series = sinusoids((21.3, 400), seed=0) + sinusoids((21.2, 300), seed=1, axis=1)
    found = lbt.identification.LineFollower(plant)(series, np.zeros_like(series))
    assert [v.frequency_hz for v in found.vibrations] == pytest.approx([21.3, 21.2], abs=0.02)


def test_no_line_is_no_plant():
    plant = axis(20)
    follow = lbt.identification.LineFollower(plant)
    still = lbt.Truth(turbulence=AIR, noise_nm=15.5)
    rng = np.random.default_rng(5)
    size = {"frames": 3200, "cases": 1, "rng": rng}
    calm = (
        draw_disturbance(still, plant.hardware, **size) + draw_noise(still, plant.hardware, **size)
    )[0]
    assert follow(calm, np.zeros_like(calm)) is None
    assert follow(calm[:100], np.zeros((100, 1))) is None  # nor is a window without resolution
    shaken = calm + 30 * np.cos(2 * np.pi * 22 * np.arange(3200)[:, None] / 800)
    found = follow(shaken, np.zeros_like(calm))
    assert found.vibrations[0].frequency_hz == pytest.approx(22, abs=0.05)


def test_wrong_followers_are_refused():
    with pytest.raises(lbt.errors.ProblemError, match="a vibration to follow"):
        lbt.identification.LineFollower(axis())
    blind = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=AIR,
        noise_nm=1,
        sensor_matrix=[[1.0, 1.0]],
        vibrations=[replace(line(20), direction=(1, 0))],
    )
    with pytest.raises(lbt.errors.ProblemError, match="every mode must be measured"):
        lbt.identification.LineFollower(blind)
    with pytest.raises(lbt.errors.ProblemError, match="span_hz must be above 0"):
        lbt.identification.LineFollower(axis(20), span_hz=0)
    with pytest.raises(lbt.errors.ProblemError, match="expected a TipTiltPlant"):
        lbt.identification.LineFollower("plant")
    with pytest.raises(lbt.errors.DimensionError, match=r"must be \(frames, 1\) and \(frames, 1\)"):
        lbt.identification.LineFollower(axis(20))(np.zeros((100, 2)), np.zeros((100, 1)))
