"""Factors of a channel in the bands of lines whose skirts reach into each other's band."""

import numpy as np
import pytest
from support.line_bands import FACTORS, make_bands

from lbt_synth.identification.accelerometers.line_bands import fit_band
from lbt_synth.identification.accelerometers.transfers import fit_pairs


def test_the_skirts_of_lines_of_other_bands_are_taken_away():
    for j, band in enumerate(make_bands()):
        known = fit_band(band, 0, np.where(np.arange(3) == j, 99.0, FACTORS))
        assert known.factors[0] == pytest.approx(FACTORS[j], rel=1e-9)
        # a line that is a hundredth larger in the wavefront has a factor a hundredth smaller
        assert known.slopes[0] == pytest.approx(-0.01 * FACTORS[j], rel=1e-9)
        assert known.errors(0)[0] == pytest.approx(0.01 * abs(FACTORS[j]), rel=1e-6)
        np.testing.assert_allclose(known.readings, FACTORS[j] * band.expected[:, j], rtol=1e-9)
        # what they are taken for where nothing is known of them: a regression on the line alone
        x = band.expected[:, j]
        alone = fit_band(band, 0, np.zeros(3, dtype=complex)).factors[0]
        assert alone == pytest.approx(np.vdot(x, band.readings[:, 0]) / np.vdot(x, x), rel=1e-9)
        if j:
            assert abs(alone / FACTORS[j] - 1) > 0.1


def test_bands_that_see_each_others_lines_find_all_factors():
    """Left in, the skirts of the strong line cost the weak ones more than their whole factor."""
    for band, fit, j, _ in fit_pairs(make_bands()):
        assert abs(fit.factors[j] - FACTORS[band.lines[j]]) < 0.02
