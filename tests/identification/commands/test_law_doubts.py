"""Series that no option repairs: exchanged, recorded twice, of another night, slipped."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.wrong_commands import record

from lbt_synth.identification.commands.verdict import explain_commands


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
        (slipped, "they follow their measurements 1 frame later than before"),
    ],
)
def test_what_cannot_be_is_named(spoil, words: str) -> None:
    verdict = explain_spoilt(spoil)
    assert words in verdict.explanation
    assert not verdict.accepted
    assert verdict.options == ""


def test_a_slip_is_found_where_it_is() -> None:
    words = explain_spoilt(slipped).explanation
    first, last = [int(word) for word in words.split() if word.isdigit()][:2]
    assert first < 6000 < last


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
