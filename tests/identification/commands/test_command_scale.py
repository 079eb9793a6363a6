"""The factor of commands, against gains that are drawn around plausible ones."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.identification.commands.command_scale import PLAUSIBLE_GAINS, likely_factor


@pytest.mark.parametrize("gain", [0.2, 0.7, 1.25, 1.64])
@pytest.mark.parametrize("factor", [1e-9, 1e-3, 1e3])
def test_units_are_powers_of_ten_however_coarse_the_gain(gain, factor) -> None:
    found, usual = likely_factor(factor * gain * np.array([0.9, 1.1]), PLAUSIBLE_GAINS)
    assert found == pytest.approx(factor)
    assert usual == 0.7


def test_other_factors_bring_a_usual_gain() -> None:
    assert likely_factor(np.array([4.0]), (0.9, 1.0)) == (pytest.approx(4.4), 0.9)
