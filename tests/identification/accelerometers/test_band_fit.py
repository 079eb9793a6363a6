"""Factors of a channel in the bands of lines whose skirts reach into each other's band."""

import numpy as np
import pytest

from lbt_synth.identification.accelerometers.band_fit import fit_band
from lbt_synth.identification.accelerometers.line_bands import LineBand
from lbt_synth.identification.accelerometers.transfers import fit_pairs

FACTORS = np.array([3.0 - 1.0j, -0.4 + 0.2j, 0.7j])


def make_bands():
    """Return a band per line; every line shows in every band, the strong first one most."""
    rng = np.random.default_rng(4)
    out = []
    for j in range(3):
        parts = rng.standard_normal((2, 60, 3)) * [3.0, 0.3, 0.3]
        expected = parts[0] + 1j * parts[1]
        expected[:, j] *= 2
        band = LineBand(
            lines=(j,),
            angle=np.linspace(0.1, 0.2, 60) + j,
            readings=expected @ FACTORS[:, None],
            expected=expected,
            unseen=np.zeros((60, 3, 3)),
            core=np.ones((60, 1), dtype=bool),
            follows=np.ones(59, dtype=bool),
        )
        out.append(band)
    return out


def test_the_skirts_of_lines_of_other_bands_are_taken_away():
    for j, band in enumerate(make_bands()):
        known = fit_band(band, 0, np.where(np.arange(3) == j, 99.0, FACTORS))
        assert known.factors[0] == pytest.approx(FACTORS[j], rel=1e-9)
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
