"""The channels of a record, with one thing wrong at a time, and the costs of a disturbance."""

from __future__ import annotations

import numpy as np
import pytest
from support.control_laws import RATE, ordinary_loop
from support.diagnoses import line_diagnosis
from support.wrong_commands import record

import lbt_synth as lbt
from lbt_synth.identification import loop_record
from lbt_synth.identification.commands.verdict import explain_commands
from lbt_synth.identification.diagnosis.rows import (
    disturbance_costs,
    disturbance_lines,
    judge_channels,
    live_axes,
)


@pytest.mark.parametrize(
    ("spoil", "doubt", "advice"),
    [
        (lambda u: u[:, [0, 0]], "one axis was recorded twice", "find the commands that belong"),
        (lambda u: 30 * np.round(u / 30), "which hides the sensor gain", "record more digits"),
    ],
)
def test_advice_is_that_of_the_explanation(spoil, doubt: str, advice: str) -> None:
    y, u = ordinary_loop()
    verdict = explain_commands(record(y, spoil(u)))
    assert verdict.doubt.endswith(doubt)
    assert verdict.advice.startswith(advice)
    assert np.isnan(verdict.gain).all()
    assert verdict.facts().repair == verdict.options


def states(y, u=None):
    """Return the states of the channels, their rows, and the axes that live."""
    delay = None if u is None else 2
    made = loop_record(y, u, frame_rate_hz=RATE, delay_frames=delay, unit="nm")
    rows = judge_channels(made)
    return {row.channel: row.state for row in rows}, rows, live_axes(made)


def loop():
    return [series.copy() for series in ordinary_loop()]


CHANNELS = ["tip measurement", "tilt measurement", "tip command", "tilt command"]


def test_a_good_record():
    y, u = loop()
    found, rows, live = states(y, u)
    assert found == dict.fromkeys(CHANNELS, "good")
    assert live == [0, 1]
    assert not any(row.serious for row in rows)
    np.testing.assert_allclose([row.rms_nm for row in rows[:2]], np.std(y, axis=0))
    steps = np.sqrt(np.mean(np.diff(u, axis=0) ** 2, axis=0))
    np.testing.assert_allclose([row.step_nm for row in rows[2:]], steps)
    assert list(states(y[:, :1])[0]) == ["measurement"]


TIME = np.linspace(0, 1, len(ordinary_loop()[0]))
NOISE = np.random.default_rng(0).standard_normal(TIME.size)


def held(x):
    x = x.copy()
    x[2000:2900] = 7.0
    return x


@pytest.mark.parametrize(
    ("channel", "spoil", "word"),
    [
        (1, lambda x: 0 * x, "dead"),
        (0, held, "stuck (9 %)"),
        (3, lambda x: np.clip(x, -250, 250), "clipped ("),
        (0, lambda x: x + 150 * NOISE, "noisy"),
        (0, lambda x: x + 400 * TIME, "drifting"),
        (1, lambda x: x * (0.3 + 1.7 * TIME), "scatter changes"),
    ],
)
def test_a_bad_channel(channel, spoil, word):
    series = np.hstack(loop())
    series[:, channel] = spoil(series[:, channel])
    found, rows, live = states(series[:, :2], series[:, 2:])
    assert live == ([0] if word == "dead" else [0, 1])
    assert found.pop(CHANNELS[channel]).startswith(word)
    assert set(found.values()) == {"good"}
    assert [row.channel for row in rows if row.serious] == [CHANNELS[channel]]


def test_few_outliers_are_not_serious():
    y, u = loop()
    y[[500, 3000], 0] += 1e4
    found, rows, _ = states(y, u)
    assert found["tip measurement"].startswith("outliers (0.0")
    assert not any(row.serious for row in rows)


def costs_of(*controllers):
    """Return the plant of a good record, and the costs of its disturbances in two loops."""
    model = line_diagnosis().model
    plant, lines = model.plant(), disturbance_lines(model)
    return plant, disturbance_costs(plant, lines, *controllers, lbt.Imaging())


def law(gain):
    return lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=1e-3)


def test_squares_add_up_to_the_budget():
    running, best = law(0.2), line_diagnosis().best_design.controller
    plant, costs = costs_of(running, best)
    *parts, total = costs
    for field, controller in (("running_nm", running), ("best_nm", best)):
        loop = lbt.close_loop(plant.hardware, controller)
        exact = lbt.residual_budget(loop, plant, frame_means=True)
        values = {row.part: getattr(row, field) for row in costs}
        assert values["all"] == pytest.approx(exact.rms_nm, rel=1e-6)
        assert values["measurement noise"] == pytest.approx(exact.noise_nm, rel=1e-6)
        assert np.hypot.reduce([values[row.part] for row in parts]) == pytest.approx(values["all"])
    ordered = [row.running_nm for row in parts]
    assert ordered == sorted(ordered, reverse=True)
    assert total.part == "all"


def test_strehl_ratio_that_a_part_costs():
    line, *_, total = line_diagnosis().costs
    rest = total.running_nm**2 - line.running_nm**2
    strehl, without = (
        lbt.loop.jitter_strehl([[power]], imaging=lbt.Imaging())
        for power in (total.running_nm**2, rest)
    )
    assert total.running_strehl == pytest.approx(1 - strehl, rel=1e-6)
    assert line.running_strehl == pytest.approx(without - strehl, rel=1e-6)


def test_loops_that_are_not_known_cost_nothing_that_is_known():
    _, rows = costs_of(law(5.0), line_diagnosis().best_design.controller)
    assert all(np.isnan([row.running_nm, row.running_strehl]).all() for row in rows)
    best = [row.best_nm for row in rows[:-1]]
    assert best == sorted(best, reverse=True)
    assert costs_of(None, None)[1] == ()
