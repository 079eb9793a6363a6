"""Poles fitted to a response."""

import numpy as np

from lbt_synth.design.shaping.reduction import WeightedResponse, fit_poles


def test_poles_of_a_response_are_found():
    poles = np.array([0.97 * np.exp(0.2j), 0.97 * np.exp(-0.2j), 0.5, 0.85])
    angles = np.linspace(0, np.pi, 400)
    z = np.exp(1j * angles)
    target = z**2 * (z + 0.3) * z / np.prod(z[:, None] - poles, axis=1)
    start = np.array([0.9 * np.exp(0.3j), 0.9 * np.exp(-0.3j), 0.1, 0.7])
    found, misfit = fit_poles(WeightedResponse(z, target, np.ones(400)), start)
    assert misfit < 1e-6
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(poles), atol=1e-4)
