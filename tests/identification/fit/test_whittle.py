"""The likelihood: gradient and information."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from support.recorded_loops import integrator_loop

from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.whittle import GAIN, Likelihood

RATE = 1000.0


FRAMES = 16_384


def likelihood() -> tuple[Likelihood, np.ndarray]:
    y, c = integrator_loop(lines=((40, 0.01, 30),), frames=4096)
    data = loop_periodogram(y[:, 0], c[:, 0], frame_rate_hz=RATE, stretches=[(0, len(y))])
    w = 2 * np.pi / RATE
    theta = np.array(
        [
            np.log(0.7),
            np.log(30),
            np.log(20 * w),
            np.log(1.1 * w),
            np.log(0.5),
            np.log(200.0**2),
            np.log(39 * w),
            np.log(0.02 / 0.98),
            np.log(15.0**2),
        ]
    )
    return Likelihood(data), theta


def test_gradient_and_information_of_the_likelihood() -> None:
    like, theta = likelihood()
    value, gradient, information = like.derivatives(theta)
    assert value == pytest.approx(like.contrast(theta), rel=1e-12)
    numeric = approx_fprime(theta, like.contrast, 1e-6)
    assert gradient == pytest.approx(numeric, rel=2e-3, abs=1e-3 * np.max(np.abs(numeric)))
    # the rows of the gain are exact second derivatives
    for h in (1e-5,):
        step = np.zeros(theta.size)
        step[GAIN] = h
        row = (like.derivatives(theta + step)[1] - like.derivatives(theta - step)[1]) / (2 * h)
        assert information[GAIN] == pytest.approx(row, rel=1e-4, abs=1e-4 * np.max(np.abs(row)))
    # the others are those of the model where the data are the model
    pure = Likelihood(
        dataclasses.replace(
            like.data,
            measured=like.model(theta),
            crossed=np.zeros_like(like.data.crossed),
            corrected=np.zeros_like(like.data.corrected),
        )
    )
    _, flat, expected = pure.derivatives(theta)
    assert flat == pytest.approx(0, abs=1e-8)
    rows = np.array(
        [
            (pure.derivatives(theta + h)[1] - pure.derivatives(theta - h)[1]) / 2e-5
            for h in 1e-5 * np.eye(theta.size)[1:]
        ]
    )
    assert expected[1:, 1:] == pytest.approx(rows[:, 1:], rel=1e-3, abs=1e-3 * np.max(rows))
