"""Series that no option repairs: exchanged, recorded twice, of another night, held, in steps."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from lbt_synth.identification.likeliest_gain import allowed_gains
from support.control_laws import ordinary_loop
from support.wrong_commands import record

import lbt_synth as lbt
from lbt_synth.identification.commands.coarse_spectrum import CoarseRecord
from lbt_synth.identification.commands.doubts import gain_dilution, held_while_moving
from lbt_synth.identification.commands.verdict import explain_commands

RATE_HZ, FRAMES = 800.0, 8000
HELD = np.arange(FRAMES) // 2000 % 2 == 1


def slipped(y, u):
    later = u.copy()
    later[6000:] = u[5999:-1]
    return y, later


def of_another_night(y, u):
    return y, np.column_stack([u[:, 0], ordinary_loop(5)[1][:, 1]])


@cache
def explain_spoilt(spoil):
    """Return the verdict on the series of an ordinary loop, spoilt."""
    return explain_commands(record(*spoil(*ordinary_loop())))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda y, u: (u, y), "as if both had been exchanged"),
        (lambda y, u: (y, u[:, [0, 0]]), "one axis was recorded twice"),
        (lambda y, u: (y, u[:, [1, 1]]), "one axis was recorded twice"),
        (of_another_night, "those of axis 1 have nothing to do with its measurements"),
        (lambda y, u: (np.diff(y[:5000], axis=0), u[1:5000]), "unstable at any sensor gain"),
        (slipped, "follow their measurements at different lags, 0 and 1 frames"),
    ],
)
def test_what_cannot_be_is_named(spoil, words: str) -> None:
    verdict = explain_spoilt(spoil)
    assert words in verdict.explanation
    assert not verdict.accepted
    assert verdict.options == ""


def test_an_axis_whose_commands_stand_still_is_an_open_loop() -> None:
    y, u = ordinary_loop()
    still = u * [1.0, 0.0]
    verdict = explain_commands(record(y, still))
    assert verdict.accepted
    assert verdict.notes[-1] == "the commands of axis 1 stand still: its loop was open"
    for gain in (0.6, [0.6], [0.6, 0.7]):
        assert explain_commands(record(y, still), sensor_gain=gain).notes == verdict.notes
    assert np.isnan(verdict.gain[1])
    assert verdict.gain[0] == pytest.approx(0.7, rel=0.3)
    assert explain_commands(record(y, -still)).options == "--command-sign -1"


@pytest.mark.parametrize("late", [4, 6, 8])
def test_a_long_shift_is_that_of_the_law(late: int) -> None:
    y, u = ordinary_loop()
    verdict = explain_commands(record(y[late:], u[:-late]))
    assert verdict.options == f"--command-shift-frames -{late}"


def run_loop(held, *, sensor_gain=1.0, seed=0):
    """An integrator on a drift, frame by frame; it stands still where it is held."""
    rng = np.random.default_rng(seed)
    phi, y, u = np.zeros((3, FRAMES, 2))
    for k in range(1, FRAMES):
        phi[k] = 0.99 * phi[k - 1] + 15 * rng.standard_normal(2)
        corrected = u[k - 2] if k > 1 else 0
        y[k] = sensor_gain * (phi[k - 1] - corrected) + 10 * rng.standard_normal(2)
        u[k] = u[k - 1] if held[k] else u[k - 1] + 0.3 * y[k]
    return y, u


def record_of(y, u):
    return lbt.identification.loop_record(
        y, u, frame_rate_hz=RATE_HZ, delay_frames=2, unit="nm", diameter_m=8.22
    )


@pytest.mark.parametrize("sensor_gain", [0.5, 1.0])
def test_a_loop_that_was_held_is_a_good_record(sensor_gain):
    record = record_of(*run_loop(HELD, sensor_gain=sensor_gain))
    assert held_while_moving(record) == ""
    assert explain_commands(record).accepted


@pytest.mark.parametrize("sensor_gain", [0.5, 1.0])
@pytest.mark.parametrize("axes", [[0], [0, 1]])
def test_a_record_of_the_commands_that_stops_is_refused(sensor_gain, axes):
    y, u = run_loop(np.zeros(FRAMES, dtype=bool), sensor_gain=sensor_gain)
    for k in np.flatnonzero(HELD):
        u[k, axes] = u[k - 1, axes]
    verdict = explain_commands(record_of(y, u))
    assert not verdict.accepted
    assert "they stand still in 50 % of the frames" in verdict.explanation


def test_short_stretches_are_not_judged():
    y, u = run_loop(np.zeros(FRAMES, dtype=bool))
    u[1000:1200] = u[1000]
    assert held_while_moving(record_of(y, u)) == ""


def rounded(step_nm: float, frames: int | None = None):
    y, u = ordinary_loop()
    return record(y[:frames], step_nm * np.round(u[:frames] / step_nm))


def test_fine_steps_change_nothing() -> None:
    assert gain_dilution(CoarseRecord(record(*ordinary_loop())))[0].tolist() == [1.0, 1.0]
    verdict = explain_commands(rounded(0.1))
    assert verdict.accepted
    assert verdict.notes == ()


@pytest.mark.parametrize("step_nm", [3.0, 6.0])
def test_the_gain_that_is_lost_is_about_the_one_that_is_lost_again(step_nm: float) -> None:
    record_of_steps = rounded(step_nm)
    found = explain_commands(record_of_steps)
    dilution, _ = gain_dilution(CoarseRecord(record_of_steps))
    lost = 0.7 / found.gain
    np.testing.assert_allclose(dilution, lost, rtol=0.25)


@pytest.mark.parametrize("step_nm", [10.0, 30.0])
def test_a_gain_that_drowns_in_steps_is_refused(step_nm: float) -> None:
    verdict = explain_commands(rounded(step_nm, 6000))
    assert f"in steps of {step_nm:g} nm, in which the sensor gain drowns" in verdict.explanation
    assert not verdict.accepted


def test_a_gain_that_is_known_does_not_drown() -> None:
    assert explain_commands(rounded(10.0, 6000), sensor_gain=0.7).accepted


def test_what_steps_take_stays_possible() -> None:
    low, high = allowed_gains(rounded(4.0)).T
    assert np.all((low < 0.7) & (high > 0.7))
