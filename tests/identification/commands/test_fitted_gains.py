"""Sensor gains of a fit that show commands in another unit."""

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.wrong_commands import record

import lbt_synth as lbt
from lbt_synth.identification.commands.fitted_gains import judge_fitted_gains


@pytest.mark.parametrize(
    ("gains", "errors", "options"),
    [
        ([1.6, 1.62], [0.02, 0.02], "--command-scale 2"),
        ([700.0], [5.0], "--command-scale 1000"),
        ([1.6, 1.62], [0.1, 0.1], ""),
        ([1.6, 0.8], [0.02, 0.02], ""),  # not the unit: the axes differ
        ([1.6, 1.6], [np.inf, np.inf], ""),
        ([0.1, 0.1], [0.001, 0.001], ""),
    ],
)
def test_gains_far_above_plausible_ones_are_another_unit(gains, errors, options):
    verdict = judge_fitted_gains(record(*ordinary_loop()), np.array(gains), np.array(errors))
    assert (verdict.options, verdict.accepted) == (options, not options)
    if options:
        assert "times too small" in verdict.overruled[0]
        with pytest.raises(lbt.errors.RecordError, match=options):
            verdict.require_accepted()
    else:
        verdict.require_accepted()


def test_a_fit_that_steps_carry_away_is_no_gain() -> None:
    """A fit of 0.16 beside a coarse gain of 0.86, of commands in steps of 5 nm, at a true 0.97."""
    y, u = ordinary_loop()
    stepped, little = record(y, 0.5 * np.round(u / 0.5)), np.array([0.02, 0.02])
    far = judge_fitted_gains(stepped, np.array([0.15, 0.15]), little)
    assert "in which the sensor gain drowns" in far.explanation
    assert not far.accepted
    assert judge_fitted_gains(stepped, np.array([0.66, 0.66]), little).accepted
    assert judge_fitted_gains(record(y, u), np.array([0.15, 0.15]), little).accepted
