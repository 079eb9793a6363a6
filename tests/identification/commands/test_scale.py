"""The factor of commands, against gains that are drawn around plausible ones."""

import numpy as np
import pytest

from lbt_synth.identification.commands.scale import _usual_gain, likely_factors, wrong_scale
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS


@pytest.mark.parametrize("gain", [0.2, 0.7, 1.25, 1.64])
@pytest.mark.parametrize("factor", [1e-9, 1e-3, 1e3])
def test_units_are_powers_of_ten_however_coarse_the_gain(gain, factor) -> None:
    found = likely_factors(factor * gain * np.array([0.9, 1.1]), PLAUSIBLE_GAINS)
    np.testing.assert_allclose(found, [factor, factor])
    assert _usual_gain(PLAUSIBLE_GAINS) == 0.7


def test_other_factors_bring_a_usual_gain() -> None:
    assert likely_factors(np.array([4.0]), (0.9, 1.0)).tolist() == [pytest.approx(4.4)]
    assert _usual_gain((0.9, 1.0)) == 0.9


def test_axes_far_apart_have_factors_of_their_own() -> None:
    assert likely_factors(np.array([0.8, 1.6]), PLAUSIBLE_GAINS).tolist() == [1.0, 2.0]
    found = likely_factors(np.array([700.0, 0.5]), PLAUSIBLE_GAINS)
    np.testing.assert_allclose(found, [1000.0, 1.0])
    assert likely_factors(np.array([1.4, 1.8]), PLAUSIBLE_GAINS).tolist() == [2.0, 2.0]


def test_words_for_a_scale() -> None:
    gain = np.array([0.0007])
    assert wrong_scale(np.array([0.001]), gain).startswith("they are 1000 times too large")
    assert wrong_scale(np.array([2.0]), gain).startswith("they are 2 times too small")
    assert wrong_scale(np.array([1.0, 2.0]), np.array([0.8, 1.6])) == (
        "those of axis 1 are 2 times too small (with them the sensor has a gain of 0.8, 1.6)"
    )
