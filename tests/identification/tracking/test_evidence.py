"""The evidence for an exchange: what rivals would have left, and how often chance passes."""

from __future__ import annotations

import numpy as np
import pytest
from support.tracking import axis, disturbed, run, sensed

import lbt_synth as lbt
from lbt_synth.identification.tracking.evidence import (
    FALSE_ALARM,
    find_better,
    prediction_errors,
)
from lbt_synth.identification.tracking.switching import SwitchedController
from lbt_synth.models.plant.tip_tilt import with_vibrations


@pytest.mark.parametrize("plant", [axis(18), axis(18, delay_frames=3), sensed(None)])
def test_a_rival_of_the_same_gain_leaves_what_it_leaves_when_it_runs(plant):
    """The disturbance does not depend on the filter: its own loop is the oracle."""
    frames, hw = 400, plant.hardware
    rng = np.random.default_rng(1)
    total = np.cumsum(rng.standard_normal((1, frames, hw.modes)), axis=1)
    noise = rng.standard_normal((1, frames, hw.n_measurements))
    (line,) = plant.vibrations
    rival = lbt.kalman(with_vibrations(plant, [line.at_frequency(31.0)]))
    running, alone = SwitchedController(lbt.kalman(plant)), SwitchedController(rival)
    run(running, plant, (total, noise))
    run(alone, plant, (total, noise))
    measured, alone_measured = running.window()[0], alone.window()[0]
    errors = prediction_errors(rival, *running.window())
    assert errors == pytest.approx(alone_measured, abs=1e-9 * np.max(np.abs(total)))
    assert np.max(np.abs(errors - measured)) > 1
    assert prediction_errors(running.design, *running.window()) == pytest.approx(measured)


def test_a_rival_is_judged_with_its_own_sensor_gain():
    """The filter that knows the gain predicts best, and as well whichever runs."""
    wrong, right = axis(18), axis(18, sensor_gain=0.5)
    best = []
    series = disturbed(right, frames=2400, hz=18, damping=0.02)
    for runs in (wrong, right):
        running = SwitchedController(lbt.kalman(runs))
        run(running, right, series)
        errors = [
            np.mean(prediction_errors(lbt.kalman(plant), *running.window())[400:] ** 2)
            for plant in (wrong, right)
        ]
        assert errors[1] < 0.9 * errors[0]
        best.append(errors[1])
    assert best[0] == pytest.approx(best[1])


def test_equal_filters_pass_as_rarely_as_chance_has_it():
    """Paired white differences follow Student's t: one test of the least length has that rate."""
    rng, draws = np.random.default_rng(2), 8_000
    losses = 1e-3 + rng.standard_normal((draws, 2, 8))  # a batch is one frame at 20 Hz
    passed = sum(find_better(each, 0, 20.0) is not None for each in losses)
    expected = FALSE_ALARM * draws
    assert abs(passed - expected) < 4 * np.sqrt(expected)


def test_the_longest_frames_find_what_the_last_hide():
    rng = np.random.default_rng(3)
    losses = np.full((3, 4000), 100.0)
    losses[1] -= 2 + 4 * rng.standard_normal(4000)  # 2 % less
    losses[2] -= 0.5  # surely, but not worth it
    found = find_better(losses, 0, 800.0)
    assert (found.rival, found.share) == (1, pytest.approx(0.02, rel=0.2))
    assert find_better(losses[:, :300], 0, 800.0) is None  # less than 0.4 s
    assert find_better(losses, 1, 800.0) is None
    assert find_better(losses[[0, 2]], 0, 800.0) is None
    assert find_better(np.zeros((2, 4000)), 0, 800.0) is None
    losses[2, -400:] = 50
    found = find_better(losses, 0, 800.0)
    assert (found.rival, found.seconds) == (2, 0.4)
