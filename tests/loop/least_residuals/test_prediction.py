"""The prediction error by series and by weight."""

import pytest
from support.limits import ar, path, variance

from lbt_synth.loop.least_residuals.prediction import InnerFactor


@pytest.mark.parametrize("delay", [2.75, 6.8])
def test_both_ways_to_the_value_at_the_zero(delay, monkeypatch):
    from lbt_synth.loop.least_residuals import prediction

    truth = {"turbulence": ar(1.5, -0.8), "noise_nm": 0.4}
    values = []
    for few in (1e-300, 1.0):
        monkeypatch.setattr(prediction, "_FEW_DIGITS", few)
        inner = InnerFactor.of(path(delay))
        assert (inner.terms > inner.whole) is (few == 1.0)  # the value is summed from its series
        values.append(variance(path(delay), **truth))
    assert values[0] == pytest.approx(values[1], rel=1e-8)
