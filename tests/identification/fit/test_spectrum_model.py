"""The parameters of a spectrum."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.identification.fit.spectrum_model import Component, SpectrumModel


def test_parameters_keep_their_names_in_a_vector() -> None:
    turbulence = Component("turbulence", -5.0, -0.7, 10.6)
    line = Component("line", -1.4, -3.9, 5.4)
    spectrum = SpectrumModel(-0.4, 3.4, 0.3, -2.1, (turbulence, line))
    theta = spectrum.pack()
    assert spectrum.unpack(theta) == spectrum
    named = spectrum.unpack(np.arange(10.0))
    assert (named.log_gain, named.log_noise, named.colour, named.log_corner) == (0, 1, 2, 3)
    turbulence, line = named.components
    assert (turbulence.log_frequency, turbulence.damping, turbulence.log_power) == (4, 5, 6)
    assert (line.log_frequency, line.damping, line.log_power) == (7, 8, 9)
    with pytest.raises(ValueError, match="zip"):
        spectrum.unpack(theta[:-3])
