"""Recorded commands with few digits, beside the same loop with all of them."""

from __future__ import annotations

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.wrong_commands import record

from lbt_synth.identification.commands.coarse_steps import command_steps, gain_dilution
from lbt_synth.identification.commands.gain_interval import allowed_gains
from lbt_synth.identification.commands.guesses import CoarseRecord
from lbt_synth.identification.commands.verdict import explain_commands


def rounded(step_nm: float, frames: int | None = None):
    y, u = ordinary_loop()
    return record(y[:frames], step_nm * np.round(u[:frames] / step_nm))


def test_steps_are_those_of_the_values() -> None:
    u = ordinary_loop()[1]
    columns = np.column_stack([2.5 * np.round(u[:, 0] / 2.5) + 0.3, u[:, 1]])
    np.testing.assert_allclose(command_steps(columns, np.ones(len(u), dtype=bool)), [2.5, 0.0])
    still = np.zeros((50, 2))
    assert command_steps(still, np.ones(50, dtype=bool)).tolist() == [0.0, 0.0]


def test_fine_steps_change_nothing() -> None:
    assert gain_dilution(CoarseRecord(record(*ordinary_loop()))).tolist() == [1.0, 1.0]
    verdict = explain_commands(rounded(0.1))
    assert verdict.accepted
    assert verdict.notes == ()


@pytest.mark.parametrize("step_nm", [3.0, 6.0])
def test_the_gain_that_is_lost_is_about_the_one_that_is_lost_again(step_nm: float) -> None:
    record_of_steps = rounded(step_nm)
    found = explain_commands(record_of_steps)
    dilution = gain_dilution(CoarseRecord(record_of_steps))
    lost = 0.7 / found.gain
    np.testing.assert_allclose(dilution, lost, rtol=0.25)
    assert "recorded in steps of" in (found.explanation + " ".join(found.notes))


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
