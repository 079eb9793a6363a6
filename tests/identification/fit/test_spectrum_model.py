"""The parameters of spectra, and what is left when a shared resonance goes."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.identification.fit.spectrum_model import (
    SHARED,
    Component,
    Spectra,
    SpectrumModel,
)


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


def test_shared_resonances_have_parameters_on_both_axes() -> None:
    turbulence, line = Component("turbulence", -5.0, -0.7, 10.6), Component("line", -1.4, -3.9, 5.4)
    own = (
        SpectrumModel(-0.4, 3.4, 0.3, -2.1, (turbulence, line)),
        SpectrumModel(-0.2, 3.1, 0.0, -2.0, (turbulence,)),
    )
    shared = Component("line", -2.0, -3.0, 4.0, log_ratio=-0.5, phase=2.5, before=(line, None))
    spectra = Spectra(own, (shared,))
    theta = spectra.pack()
    assert theta.size == 10 + 7 + SHARED
    assert spectra.unpack(theta) == spectra
    assert [c.log_power for c in spectra.lines] == [4.0, 5.4]
    for i, power in enumerate((4.0, 3.5)):
        whole = spectra.whole(i)
        assert whole.components[-1] == Component("line", -2.0, -3.0, power)
        step = np.random.default_rng(i).standard_normal(theta.size)
        moved = spectra.unpack(theta + step).whole(i).pack() - whole.pack()
        assert spectra.axis_map(i) @ step == pytest.approx(moved)
    apart = spectra.release(0, *shared.before)
    assert not apart.shared
    assert [len(axis.components) for axis in apart.axes] == [3, 1]
    assert apart.axes[0].components[2] == line
    assert spectra.release(0).axes == own
