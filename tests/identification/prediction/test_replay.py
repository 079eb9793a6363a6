"""Where replays start, and what the start may still add to the test."""

from __future__ import annotations

import numpy as np
import pytest
from support.predictions import RATE, a_series

import lbt_synth as lbt
from lbt_synth.identification.prediction.replay import choose_warm_up, replay, replay_frames

PATH = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
SWELL = lbt.models.ARModel(coefficients=[1.97, -0.972], driving_rms_nm=4.0, frame_rate_hz=RATE)


def slow_loop(gain: float = 0.002) -> lbt.loop.ClosedLoop:
    """A loop that forgets its start within 1 / gain frames."""
    return lbt.close_loop(PATH, lbt.integrator(PATH, gain=gain).controller)


def test_the_start_adds_what_the_definition_says():
    """The record's own states, then zeros for ever; decaying frame by frame."""
    loop = slow_loop(0.05)
    z = a_series(SWELL, 500, np.random.default_rng(0))[:, None]
    path = loop.rejection()
    state, moments = np.zeros(path.n_states), np.zeros((path.n_states, path.n_states))
    for value in [*(z[:, 0] - np.mean(z[:64])), *np.zeros(3000)]:
        moments += np.outer(state, state)
        state = path.A @ state + path.B[:, 0] * value
    frames = replay_frames(((0, 500),), ((100, 200), (350, 500)))
    row, squares = path.C, []
    for _ in range(500):
        squares.append(float((row @ moments @ row.T)[0, 0]) / 500)
        row = row @ path.A
    found = replay(loop, z, ((0, 500),), from_rest=False).left_of_start(frames)
    wanted = np.mean([*squares[100:200], *squares[350:500]])
    assert found[0, 0] == pytest.approx(wanted, rel=1e-9)


def test_the_start_adds_what_replays_of_a_longer_record_show():
    """The difference between a replay that knows the past and one that begins later."""
    loop, added, promised = slow_loop(), [], []
    for seed in range(60):
        z = a_series(SWELL, 12_000, np.random.default_rng(seed))[:, None]
        whole, late = (replay(loop, z, ((first, 12_000),), from_rest=False) for first in (0, 8000))
        frames = replay_frames(((8000, 12_000),), ((8500, 12_000),))
        away = (late.residual - whole.residual)[8500:]
        added.append(np.mean(away**2))
        promised.append(late.left_of_start(frames)[0, 0])
    # of 60 squares of one number each
    assert np.mean(added) == pytest.approx(np.mean(promised), rel=0.5)


def test_frames_before_the_test_warm_the_loop_up():
    z = 1e3 + a_series(SWELL, 4000, np.random.default_rng(1))[:, None]
    loop = slow_loop(0.05)
    after_others, after_a_gap = (((0, 4000),), 0), (((2000, 4000),), 5)
    for runs, least in (after_others, after_a_gap):
        frames, run = replay_frames(runs, ((2000, 4000),)), replay(loop, z, runs, from_rest=False)
        warm_up = choose_warm_up([run], frames)
        kept = frames.without(warm_up)
        assert least <= warm_up <= 10 * least
        assert np.trace(run.left_of_start(kept)) < 0.2 * run.scatter(kept)
        # more frames or fewer have a larger error
        errors = [
            run.scatter(kept) ** 2 * kept.count / part.count
            + np.trace(run.left_of_start(part)) ** 2
            for part in (frames.without(w) for w in (warm_up // 2, warm_up, 2 * warm_up))
        ]
        assert min(errors) == errors[1]


def test_a_loop_that_never_forgets_keeps_its_frames_and_says_so():
    """Dropping frames would cost more than it saves: the error holds what the start may add."""
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=SWELL, noise_nm=4.0, modes=1)
    rng = np.random.default_rng(3)
    z = (a_series(SWELL, 9000, rng) + 4 * rng.standard_normal(9000))[:, None]
    quick, pole = lbt.kalman(plant), 0.99998
    # a correction of 0.1 of the mean over 50,000 frames, beside a FIR predictor of 3 frames
    fit = lbt.identification.least_squares_predictor(z, PATH, taps=3).coefficients[0, 0]
    A, B = np.diag([1.0, 1.0], -1)[:, :3], np.array([[1.0], [0.0], [0.0]])
    parameter = lbt.Controller(
        A=np.block([[A, np.zeros((3, 1))], [np.zeros((1, 3)), np.array([[pole]])]]),
        B=np.vstack([B, [[1 - pole]]]),
        C=np.array([[*fit, 0.1]]),
        D=np.zeros((1, 1)),
        dt_s=1 / RATE,
    )
    lazy = lbt.loop.youla_controller(PATH, parameter)
    table = lbt.identification.prediction_against_data(plant, z, {"lazy": lazy, "quick": quick})
    (note,) = table.notes
    assert "the state of the lazy before the record is not known" in note
    assert "slow modes (pole 0.999980) may contribute up to" in note
    assert all(row.replayed.stretches == table.test for row in table.entries[:-1])
    assert table.test[0][0] < 7000
    start = float(np.trace(table["lazy"].replayed.start_nm2))
    assert table["lazy"].replayed.total_error_nm2 > start > 10 * table["quick"].replayed.start_nm2
    alone = lbt.identification.prediction_against_data(plant, z, {"quick": quick})
    assert alone.notes == ()
    assert abs(alone["quick"].deviations) < 4
    assert alone.test == ((4500, 9000),)
