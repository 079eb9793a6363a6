"""Modes that decouple, and the path through which they are predicted."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from support.limits import RATE, Anonymous, ar, path, variance
from support.refusals import require_refusals
from support.uneven_axes import LOOPS, QUICK, SLOW

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.loop.least_residuals.mode_spectra import InnerFactor


def test_more_measurements_than_modes():
    """Two equal sensors of one mode halve the noise; a mixed sensor can be undone."""
    model = {"turbulence": ar(0.99)}
    double = path(sensor_matrix=[[1.0], [1.0]])
    assert variance(double, **model, noise_nm=2.0) == pytest.approx(
        variance(path(), **model, noise_nm=np.sqrt(2))
    )
    mixed = path(modes=2, sensor_matrix=[[2.0, 1.0], [1.0, 2.0]])  # noise of 1 and 1/3
    assert variance(mixed, **model, noise_nm=3.0) == pytest.approx(
        variance(path(), **model, noise_nm=3.0) + variance(path(), **model, noise_nm=1.0)
    )


def test_equal_models_may_be_turned_into_each_other():
    """Two models of the same numbers are one turbulence: a vibration across them decouples."""
    both, _ = LOOPS
    again = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=60.0, frame_rate_hz=RATE)
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=(1, 1))
    one = lbt.loop.least_residual(both, lbt.Truth(turbulence=SLOW, vibrations=[line], noise_nm=5))
    two = lbt.loop.least_residual(
        both, lbt.Truth(turbulence=[SLOW, again], vibrations=[line], noise_nm=5)
    )
    assert two.rms_nm == pytest.approx(one.rms_nm, rel=1e-12)
    with pytest.raises(lbt.errors.ProblemError, match="a limit needs modes that decouple"):
        lbt.loop.least_residual(
            both, lbt.Truth(turbulence=[SLOW, QUICK], vibrations=[line], noise_nm=5)
        )


@pytest.mark.parametrize("delay", [2.75, 6.8])
def test_both_ways_to_the_value_at_the_zero(delay, monkeypatch):
    from lbt_synth.loop.least_residuals import mode_spectra

    truth = {"turbulence": ar(1.5, -0.8), "noise_nm": 0.4}
    values = []
    for few in (1e-300, 1.0):
        monkeypatch.setattr(mode_spectra, "_FEW_DIGITS", few)
        inner = InnerFactor.of(path(delay), in_image=False)
        assert (inner.terms > inner.whole) is (few == 1.0)  # the value is summed from its series
        values.append(variance(path(delay), **truth))
    assert values[0] == pytest.approx(values[1], rel=1e-8)


@pytest.mark.parametrize(
    ("delay", "noise", "model"),
    [(1.5, 10.0, ar(0.9)), (2.01, 0.2, ar(1.5, -0.8)), (2.75, 0.2, ar(1.7, -0.75))],
)
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


CALM = {"turbulence": ar(0.9), "noise_nm": 1.0}
SLANTED, UPRIGHT = (
    lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=5, direction=d) for d in ((1, 1), (1, 0))
)
OTHER_RATE = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=1, frame_rate_hz=500)


def shaken(hardware, *lines):
    return variance(hardware, **CALM, vibrations=lines)


def test_refusals():
    uneven, two = np.diag([1.0, 2.0]), path(modes=2)
    rows = [
        (lambda: shaken(path(sensor_matrix=[[1.0, 1.0]])), ProblemError, "got rank 1 for 2"),
        (lambda: shaken(path(influence_matrix=[[1.0], [1.0]])), ProblemError, "reach every mode"),
        (lambda: shaken(two, SLANTED, UPRIGHT), ProblemError, "that decouple.*Turn the directions"),
        (
            lambda: shaken(path(sensor_matrix=uneven), SLANTED),
            ProblemError,
            "principal axes of the",
        ),
        (lambda: shaken(path(), UPRIGHT), DimensionError, "must have 1 components"),
        (
            lambda: variance(path(), turbulence=OTHER_RATE),
            ProblemError,
            "the loop's 800 Hz; got 500",
        ),
        (
            lambda: variance(path(), turbulence=ar(0.9, driving=1e10), noise_nm=1e-155),
            ProblemError,
            "set noise_nm to 0",
        ),
    ]
    require_refusals(rows)
    for psd in (lambda f: -np.ones(f.shape), lambda f: f * np.nan, lambda f: np.ones(3)):
        with pytest.raises(ProblemError, match=r"Anonymous.psd does not"):
            variance(path(), turbulence=Anonymous(psd), noise_nm=1.0)
