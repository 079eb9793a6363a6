"""The sensor gains of a fit, which may show commands in another unit."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.commands.coarse_steps import drowns_in_steps, is_stepped
from lbt_synth.identification.commands.command_scale import likely_factors
from lbt_synth.identification.commands.explanations import wrong_scale
from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.repair import CommandRepair
from lbt_synth.identification.commands.verdict import AS_GIVEN, CommandVerdict
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.validation import FloatArray, frozen_copy

_FAR = 1.5  # factor between the gain of a fit and the coarse one of a record of steps
_FIT_ERRORS = 4.0  # of a fitted gain from a plausible one that refute the unit


def judge_fitted_gains(record: LoopRecord, gains: FloatArray, errors: FloatArray) -> CommandVerdict:
    """Judge the commands by the sensor gains (axes,) of a fit, with their standard errors.

    The fit shows gains beyond the plausible ones where the coarse model leaves them open. Where
    commands are recorded in steps, these carry a fit farther than the coarse model.
    """
    if is_stepped(record):
        coarse = CoarseRecord(record)
        own = coarse.compare([Guess(kind="as given")]).gain[:, 0]
        far = np.abs(np.log(gains / own))
        if np.max(far) > np.log(_FAR):
            why = drowns_in_steps(coarse, int(np.argmax(far)))
            return CommandVerdict(explanation=why, accepted=False, gain=frozen_copy(own), law=None)
    accepted = not np.all(gains - _FIT_ERRORS * errors > PLAUSIBLE_GAINS[1])
    scale = np.ones(gains.size) if accepted else likely_factors(gains, PLAUSIBLE_GAINS)
    return CommandVerdict(
        explanation=AS_GIVEN if accepted else wrong_scale(scale, gains),
        accepted=accepted,
        repair=None if accepted else CommandRepair(scale=tuple(scale)),
        gain=frozen_copy(gains / scale),
        law=None,
    )
