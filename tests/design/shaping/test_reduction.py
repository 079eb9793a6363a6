"""Poles fitted to a response."""

import numpy as np

from lbt_synth.design.shaping.reduction import (
    WeightedResponse,
    fit_poles,
    log_slopes,
    poles_from_vector,
    vector_from_poles,
)


def test_poles_of_a_response_are_found():
    upper = np.array([0.97 * np.exp(0.2j), 0.6 * np.exp(1.2j)])
    poles = np.concatenate([upper, upper.conj(), [0.85]])
    angles = np.linspace(0, np.pi, 400)
    z = np.exp(1j * angles)
    target = z**3 * (z + 0.3) * z / np.prod(z[:, None] - poles, axis=1)
    begin = np.array([0.9 * np.exp(0.3j), 0.4 * np.exp(1.6j)])
    start = np.concatenate([begin, begin.conj(), [0.1]])
    found, misfit = fit_poles(WeightedResponse(z, target, np.ones(400)), start)
    assert misfit < 1e-6
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(poles), atol=1e-4)


def test_slopes_of_the_logarithm_are_those_of_differences():
    x, pairs = vector_from_poles(np.array([0.9 * np.exp(0.3j), 0.9 * np.exp(-0.3j), 0.4]))
    z = np.exp(1j * np.linspace(0.1, 3, 7))

    def logarithm(x):
        upper, single = poles_from_vector(x, pairs)
        return -np.log(np.prod(z[:, None] - [*upper, *upper.conj(), *single], axis=1))

    found = log_slopes(z, *poles_from_vector(x, pairs))
    for column, move in zip(found.T, 1e-6 * np.eye(3), strict=True):
        difference = (logarithm(x + move) - logarithm(x - move)) / 2e-6
        np.testing.assert_allclose(column, difference, atol=1e-8)
