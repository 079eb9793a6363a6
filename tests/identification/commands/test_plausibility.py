"""A second opinion on a record, by the model of the fit."""

from __future__ import annotations

from dataclasses import replace

from support.recorded_loops import resonant_record

from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.plausibility import finer_saving_of_gain

AS_GIVEN = Guess(kind="as given")


def test_a_plausible_gain_is_no_reason_to_rescale_the_commands() -> None:
    """The fit's gain of 0.9 was compared with 0.35, 0.7 and 1.25, and likelier than these."""
    coarse = CoarseRecord(resonant_record())
    assert finer_saving_of_gain(coarse, AS_GIVEN, (0.35, 1.25), 0.7) == 0


def test_commands_of_another_unit_show_in_the_gain_of_the_fit() -> None:
    record = resonant_record()
    assert record.commands is not None
    coarse = CoarseRecord(replace(record, commands=10 * record.commands))
    assert finer_saving_of_gain(coarse, AS_GIVEN, (0.35, 1.25), 0.7) > 20
