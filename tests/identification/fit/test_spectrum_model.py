"""The parameters of spectra, of one axis and of two."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.identification.fit.spectrum_model import Background, Component, SpectrumModel

TURBULENCE = Component("turbulence", -5.0, -0.7, 10.6)
LINE = Component("line", -1.4, -3.9, 5.4)


def test_parameters_keep_their_names_in_a_vector() -> None:
    spectrum = SpectrumModel((Background(-0.4, 3.4, 0.3, -2.1),), (TURBULENCE, LINE))
    named = spectrum.unpack(np.arange(10.0))
    assert named.background == Background(0, 1, 2, 3)
    places = [(c.log_frequency, c.damping, c.log_power) for c in named.components]
    assert places == [(4, 5, 6), (7, 8, 9)]


def test_an_axis_shows_its_own_components_and_its_share_of_the_others() -> None:
    backgrounds = (Background(-0.4, 3.4, 0.3, -2.1), Background(-0.2, 3.1, 0.0, -2.0))
    shared = Component("line", -2.0, -3.0, 4.0, axis=None, log_ratio=-0.5, sign=-1.0, name=7)
    other = Component("turbulence", -5.0, -0.7, 9.0, axis=1)
    spectrum = SpectrumModel(backgrounds, (TURBULENCE, LINE, other, shared))
    assert spectrum.unpack(spectrum.pack()) == spectrum
    assert spectrum.pack().size == 2 * 4 + 4 * 4
    assert spectrum.shared == (3,)
    assert spectrum.directions == pytest.approx(
        np.array([[1, 0], [1, 0], [0, 1], [1, -np.exp(-0.25)]])
    )
    first, second = (spectrum.on(i) for i in range(2))
    assert first.axes == backgrounds[:1]
    assert first.components[:2] == (TURBULENCE, LINE)
    assert [c.log_power for c in first.components] == [10.6, 5.4, 4.0]
    assert [c.log_power for c in second.components] == [9.0, 3.5]
    assert all(c.axis == 0 for c in (*first.components, *second.components))
