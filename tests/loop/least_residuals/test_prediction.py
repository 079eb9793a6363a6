"""The prediction error by series and by weight, and against finite filters."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from support.limits import RATE, ar, path, variance

from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.loop.least_residuals.prediction import InnerFactor


@pytest.mark.parametrize("delay", [2.75, 6.8])
def test_both_ways_to_the_value_at_the_zero(delay, monkeypatch):
    from lbt_synth.loop.least_residuals import prediction

    truth = {"turbulence": ar(1.5, -0.8), "noise_nm": 0.4}
    values = []
    for few in (1e-300, 1.0):
        monkeypatch.setattr(prediction, "_FEW_DIGITS", few)
        inner = InnerFactor.of(path(delay), in_image=False)
        assert (inner.terms > inner.whole) is (few == 1.0)  # the value is summed from its series
        values.append(variance(path(delay), **truth))
    assert values[0] == pytest.approx(values[1], rel=1e-8)


@pytest.mark.parametrize("delay", [1.5, 2.01, 2.75])
@pytest.mark.parametrize("noise", [0.2, 10.0])
@pytest.mark.parametrize("model", [ar(0.9), ar(1.5, -0.8), ar(1.7, -0.75)], ids=["1", "2", "3"])
def test_the_mean_over_a_hold_against_a_filter_of_many_samples(delay, noise, model):
    """Normal equations of the mean over a hold, on the means over 200 past frames with noise.

    The phase has ``1 / sinc^2`` of the density of the means, and nothing above half the rate. Of
    what lies between two samples the limit knows what 32 of them tell: three digits.
    """
    f, weight = gauss_panels(np.linspace(0, 0.5, 61), 12)  # cycles per frame
    density = model.psd(f * RATE) * RATE * weight

    def covariance(lags):
        return np.cos(2 * np.pi * f * np.asarray(lags)[..., None]) @ density

    gram = toeplitz(covariance(np.arange(200))) + noise**2 * np.eye(200)
    # the newest reading at u(k) is of exposure k - 1; the hold begins delay - 1 after exposure k
    crossed = covariance(delay + np.arange(200))
    means = covariance(0.0) - crossed @ np.linalg.solve(gram, crossed)
    within = np.sum(density * (1 / np.sinc(f) ** 2 - 1))
    found = variance(path(delay), turbulence=model, noise_nm=noise, frame_means=False)
    assert found == pytest.approx(means + within, rel=1e-3)
