"""The least worst residual over a band: saddle points, designs that stay above it."""

from dataclasses import replace

import numpy as np
import pytest
from support.limits import RATE, Anonymous, ar, path, variance
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.loop import band_limit as band_module
from lbt_synth.loop.band_limit import least_worst_residual


def test_band_of_the_example(config):
    line, hardware, truth = config.truth.vibrations[0], config.hardware, config.truth
    band = {"band_hz": (16.5, 23.5), "rms_nm": line.rms_nm}
    means = least_worst_residual(hardware, truth, **band, frame_means=True)
    image = least_worst_residual(hardware, truth, **band)
    assert means.rms_nm == pytest.approx(15.1088, abs=1e-4)
    assert means.rms_nm <= means.achieved_nm < means.rms_nm * (1 + 1e-8)
    assert means.weight.sum() == pytest.approx(1)
    assert means.weight.min() >= 0
    assert 16.5 < means.frequency_hz.min() < means.frequency_hz.max() < 23.5
    # in the image no loop leaves less than the motion within a frame at the upper end
    still = lbt.loop.least_residual(hardware, replace(truth, vibrations=()))
    floor = line.rms_nm**2 * (1 - np.sinc(23.5 / RATE) ** 2)
    floor += line.rms_nm**2 * (1 - np.sinc(line.frequency_hz / RATE) ** 2)  # of the truth's line
    assert image.rms_nm**2 == pytest.approx(still.rms_nm**2 + floor)
    # what rejects the means leaves little more: their own limit takes the place of no line at all
    within = floor + still.within_nm2.sum()
    assert image.achieved_nm**2 == pytest.approx(means.rms_nm**2 + within, rel=1e-3)
    assert image.rms_nm < image.achieved_nm


def test_the_density_found_is_the_hardest(config):
    """Its Wiener limit, as a table of its own, is the band limit; the flat one is below."""
    still, band = replace(config.truth, vibrations=()), {"band_hz": (10.0, 40.0), "rms_nm": 5.0}
    limit = least_worst_residual(config.hardware, still, **band, frame_means=True)
    edges = np.linspace(10, 40, 61)
    share = np.histogram(limit.frequency_hz, edges, weights=limit.weight)[0]
    assert not np.allclose(share, 1 / 60, rtol=0.01)

    def of_density(power):
        def psd(f):
            place = np.clip(np.searchsorted(edges, f, side="right") - 1, 0, 59)
            inside = (f > 10) & (f < 40)
            return still.turbulence.psd(f) + np.where(inside, power[place] * 5**2 / 0.5, 0)

        spectrum = Anonymous(psd)
        spectrum.breakpoints_hz = edges
        own = variance(path(), turbulence=spectrum, noise_nm=still.noise_nm)
        return np.sqrt(own + limit.variance_nm2[1])

    hardest, flat = of_density(share), of_density(np.full(60, 1 / 60))
    assert flat < hardest < limit.rms_nm * (1 + 1e-9)
    assert hardest == pytest.approx(limit.rms_nm, rel=1e-3)


@pytest.mark.parametrize("delay", [1, 2.4, 3])
def test_a_controller_reaches_the_band_limit(delay):
    still = lbt.Truth(turbulence=ar(0.9886, driving=89.0), noise_nm=15.5)
    band = {"band_hz": (17, 23), "rms_nm": 500, "direction": (1,)}
    for frame_means, apart in ((True, 1e-7), (False, 0.02))[: 1 if delay % 1 else 2]:
        limit = least_worst_residual(path(delay), still, **band, frame_means=frame_means)
        assert limit.rms_nm <= limit.achieved_nm < limit.rms_nm * (1 + apart)


def test_a_narrow_band_tends_to_the_known_frequency():
    noisy = lbt.Truth(turbulence=ar(0.99), noise_nm=3.0)
    line = lbt.models.SinusoidalVibration(frequency_hz=15, rms_nm=100, direction=(1,))
    met = replace(noisy, vibrations=(line,))
    for frame_means in (True, False):
        known_nm = lbt.loop.least_residual(path(), met, frame_means=frame_means).rms_nm
        narrow = {"band_hz": (15, 15 + 1e-9), "rms_nm": 100, "direction": (1,)}
        found_nm = least_worst_residual(path(), noisy, **narrow, frame_means=frame_means).rms_nm
        assert known_nm < found_nm == pytest.approx(known_nm, rel=1e-4)
    anywhere = {"band_hz": (1e-9, 399.999999), "rms_nm": 4.0, "direction": (1,)}
    calm = lbt.Truth(turbulence=None, noise_nm=3.0)  # a line that may lie anywhere is white noise
    limit = least_worst_residual(path(), calm, **anywhere, frame_means=True)
    assert (limit.rms_nm, limit.achieved_nm) == pytest.approx((4.0, 4.0), rel=1e-6)


def test_bad_bands_and_a_search_that_does_not_settle(monkeypatch):
    still = lbt.Truth(turbulence=ar(0.9), noise_nm=1.0)
    good = {"truth": still, "band_hz": (15, 25), "rms_nm": 10, "direction": (1,)}

    def limit(delay=3, **changes):
        return lambda: least_worst_residual(path(delay), **(good | changes))

    silent, noise = lbt.Truth(turbulence=ar(0.9)), "noise on all measurements must be positive def"
    rows = [
        (limit(band_hz=(25, 20)), ProblemError, "must increase"),
        (limit(band_hz=(20, 20)), ProblemError, "For a known frequency"),
        (limit(band_hz=(20, 400)), ProblemError, "the Nyquist frequency 400"),
        (limit(band_hz=(0, 20)), ProblemError, "between 0 and"),
        (limit(direction=(1, 0)), ProblemError, "must have 1 components"),
        (limit(direction=(0,)), ProblemError, "not zero"),
        (limit(truth=silent), ProblemError, noise),
        (limit(2.4), ProblemError, "known for whole frames of delay"),
    ]
    require_refusals(rows)
    monkeypatch.setattr(band_module, "_ROUNDS", 1)
    monkeypatch.setattr(band_module, "_LARGEST_GAP", 1e-6)
    gap = refused(limit(band_hz=(1, 399), rms_nm=50), NumericalError, "a gap of .* is left")
    assert gap.residual > 0
