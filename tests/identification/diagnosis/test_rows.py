"""The channels of a record, with one thing wrong at a time, and the costs of a disturbance."""

from __future__ import annotations

import numpy as np
import pytest
from support.control_laws import RATE, ordinary_loop
from support.diagnoses import line_diagnosis
from support.wrong_commands import record

import lbt_synth as lbt
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
    record = lbt.identification.loop_record(
        y, u, frame_rate_hz=RATE, delay_frames=None if u is None else 2, unit="nm"
    )
    rows = judge_channels(record)
    return {row.channel: row.state for row in rows}, rows, live_axes(record)


def loop():
    return [each.copy() for each in ordinary_loop()]


def test_a_good_record():
    y, u = loop()
    found, rows, live = states(y, u)
    assert found == dict.fromkeys(
        ["tip measurement", "tilt measurement", "tip command", "tilt command"], "good"
    )
    assert live == [0, 1]
    assert not any(row.serious for row in rows)
    np.testing.assert_allclose([row.rms_nm for row in rows[:2]], np.std(y, axis=0))
    steps = np.sqrt(np.mean(np.diff(u, axis=0) ** 2, axis=0))
    np.testing.assert_allclose([row.step_nm for row in rows[2:]], steps)
    assert list(states(y[:, :1])[0]) == ["measurement"]


def hold(y, u):
    y[2000:2900, 0] = 7.0


def kill(y, u):
    y[:, 1] = 0.0


def clip(y, u):
    np.clip(u[:, 1], -250, 250, out=u[:, 1])


def shake(y, u):
    y[:, 0] += 150 * np.random.default_rng(0).standard_normal(len(y))


def drift(y, u):
    y[:, 0] += np.linspace(0, 400, len(y))


def grow(y, u):
    y[:, 1] *= np.linspace(0.3, 2, len(y))


@pytest.mark.parametrize(
    ("spoil", "channel", "word"),
    [
        (kill, "tilt measurement", "dead"),
        (hold, "tip measurement", "stuck (9 %)"),
        (clip, "tilt command", "clipped ("),
        (shake, "tip measurement", "noisy"),
        (drift, "tip measurement", "drifting"),
        (grow, "tilt measurement", "scatter changes"),
    ],
)
def test_a_bad_channel(spoil, channel, word):
    y, u = loop()
    spoil(y, u)
    found, rows, live = states(y, u)
    assert live == ([0] if spoil is kill else [0, 1])
    assert found.pop(channel).startswith(word)
    assert set(found.values()) == {"good"}
    assert [row.channel for row in rows if row.serious] == [channel]


def test_few_outliers_are_not_serious():
    y, u = loop()
    y[[500, 3000], 0] += 1e4
    found, rows, _ = states(y, u)
    assert found["tip measurement"].startswith("outliers (0.0")
    assert not any(row.serious for row in rows)


@pytest.fixture(scope="module")
def diagnosis():
    return line_diagnosis()


def test_squares_add_up_to_the_budget(diagnosis):
    plant = diagnosis.model.plant()
    running = lbt.Controller(A=1.0, B=0.2, C=1.0, D=0.0, dt_s=1e-3)
    best = diagnosis.best_design.controller
    costs = disturbance_costs(
        plant, disturbance_lines(diagnosis.model), running, best, lbt.Imaging()
    )
    *parts, total = costs
    for field, controller in (("running_nm", running), ("best_nm", best)):
        loop = lbt.close_loop(plant.hardware, controller)
        exact = lbt.residual_budget(loop, plant, frame_means=True)
        values = {row.part: getattr(row, field) for row in costs}
        assert values["all"] == pytest.approx(exact.rms_nm, rel=1e-6)
        assert values["measurement noise"] == pytest.approx(exact.noise_nm, rel=1e-6)
        assert np.hypot.reduce([getattr(row, field) for row in parts]) == pytest.approx(
            values["all"]
        )
    ordered = [row.running_nm for row in parts]
    assert ordered == sorted(ordered, reverse=True)
    assert total.part == "all"


def test_strehl_ratio_that_a_part_costs(diagnosis):
    total = diagnosis.costs[-1]
    lost = 1 - lbt.loop.jitter_strehl([[total.running_nm**2]], imaging=lbt.Imaging())
    assert total.running_strehl == pytest.approx(lost, rel=1e-6)
    line = diagnosis.costs[0]
    rest = total.running_nm**2 - line.running_nm**2
    without = lbt.loop.jitter_strehl([[rest]], imaging=lbt.Imaging())
    assert line.running_strehl == pytest.approx(without - (1 - lost), rel=1e-6)


def test_loops_that_are_not_known_cost_nothing_that_is_known(diagnosis):
    plant = diagnosis.model.plant()
    wild = lbt.Controller(A=1.0, B=5.0, C=1.0, D=0.0, dt_s=1e-3)
    rows = disturbance_costs(
        plant,
        disturbance_lines(diagnosis.model),
        wild,
        diagnosis.best_design.controller,
        lbt.Imaging(),
    )
    assert all(np.isnan([row.running_nm, row.running_strehl]).all() for row in rows)
    assert [row.best_nm for row in rows[:-1]] == sorted(
        (r.best_nm for r in rows[:-1]), reverse=True
    )
    assert (
        disturbance_costs(plant, disturbance_lines(diagnosis.model), None, None, lbt.Imaging())
        == ()
    )
