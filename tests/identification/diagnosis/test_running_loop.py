"""What a diagnosis says of commands that no option repairs."""

from __future__ import annotations

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.wrong_commands import record

from lbt_synth.identification.commands.verdict import explain_commands
from lbt_synth.identification.diagnosis.running_loop import command_row, doubt_commands


@pytest.mark.parametrize(
    ("spoil", "doubt", "advice"),
    [
        (lambda u: u[:, [0, 0]], "one axis was recorded twice", "find the commands that belong"),
        (lambda u: 30 * np.round(u / 30), "in which the sensor gain drowns", "record more digits"),
    ],
)
def test_advice_is_that_of_the_explanation(spoil, doubt: str, advice: str) -> None:
    y, u = ordinary_loop()
    verdict = explain_commands(record(y, spoil(u)))
    what, repair = doubt_commands(verdict)
    assert what.endswith(doubt)
    assert repair.startswith(advice)
    assert np.isnan(verdict.gain).all()
    assert command_row(verdict).repair == verdict.options
