"""A second opinion on a record, by the model of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.recorded_loops import resonant_record

from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.plausibility import finer_saving_of_gain, fit_gains
from lbt_synth.identification.commands.verdict import explain_commands

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


@pytest.mark.parametrize("factor", [0.5, 1e3])
def test_the_fit_tells_how_large_commands_are(factor: float) -> None:
    """The coarse gain is twice the true one here: wide resonances move it."""
    record = resonant_record()
    assert record.commands is not None
    record = replace(record, commands=factor * record.commands)
    coarse = CoarseRecord(record)
    gains = coarse.compare([AS_GIVEN]).gain[:, 0]
    assert np.all(gains > 1.5 * 0.9 / factor)
    np.testing.assert_allclose(fit_gains(coarse, AS_GIVEN, gains), 0.9 / factor, rtol=0.15)
    options = explain_commands(record).options
    assert options == ("" if factor < 1 else "--command-scale 0.001")  # 1.9 is left to the fit


def test_gains_that_no_fit_may_have_stay_coarse() -> None:
    gains = np.array([1e-9, 0.1])
    assert fit_gains(CoarseRecord(resonant_record()), AS_GIVEN, gains).tolist() == gains.tolist()
