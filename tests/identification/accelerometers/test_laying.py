"""The shift of the clocks of wavefront and accelerometers, and its error."""

from dataclasses import replace

import numpy as np
import pytest
from support.line_bands import make_bands

from lbt_synth.identification.accelerometers.laying import clock_shift, fit_pairs


def test_a_sensor_gain_whose_error_looks_like_a_shift_is_its_error():
    """Factors that turn in proportion to their frequency are a shift of 0.3 frames per error."""
    pairs = fit_pairs(make_bands(factors=np.array([3.0, -0.4, 0.7]), noise=0.3))
    turned = [
        (band, replace(fit, slopes=fit.factors[:, None] * 0.3j * np.mean(band.angle)), j, channel)
        for band, fit, j, channel in pairs
    ]
    still = [(band, replace(fit, slopes=0 * fit.slopes), j, c) for band, fit, j, c in pairs]
    exact, found = clock_shift(still, 3), clock_shift(turned, 3)
    assert exact.by_phases
    assert exact.error_frames < 0.1
    assert found.frames == exact.frames
    assert found.error_frames == pytest.approx(np.hypot(exact.error_frames, 0.3), rel=1e-6)
