"""The likelihood: gradient and information."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from support.recorded_loops import integrator_loop

from lbt_synth.identification.fit.periodogram import LoopPeriodogram, loop_periodogram
from lbt_synth.identification.fit.spectrum_model import GAIN, Component, SpectrumModel
from lbt_synth.identification.fit.whittle import (
    contrast,
    density,
    derivatives,
    second_derivatives,
)

RATE = 1000.0


FRAMES = 16_384


def case(*, drift: bool = False) -> tuple[LoopPeriodogram, SpectrumModel]:
    y, c = integrator_loop(lines=((40, 0.01, 30),), frames=4096)
    data = loop_periodogram(y[:, 0], c[:, 0], frame_rate_hz=RATE, stretches=[(0, len(y))])
    w = 2 * np.pi / RATE
    turbulence = Component("turbulence", np.log(1.1 * w), np.log(0.5), np.log(200.0**2))
    line = Component("line", np.log(39 * w), np.log(0.02 / 0.98), np.log(15.0**2))
    components = (turbulence, line)
    if drift:  # then all that is slow rolls off
        first = Component("drift", np.log(0.3 * w), np.log(8.0), np.log(50.0**2))
        slow = Component("slow", np.log(3 * w), 0.3, np.log(50.0**2))
        components = (first, turbulence.convert("slow"), line, slow)
    return data, SpectrumModel(np.log(0.7), np.log(30), 0.3, np.log(20 * w), components)


@pytest.mark.parametrize("drift", [False, True])
def test_gradient_and_information_of_the_likelihood(drift: bool) -> None:
    data, spectrum = case(drift=drift)
    theta = spectrum.pack()

    def gradient(theta: np.ndarray, data: LoopPeriodogram = data) -> np.ndarray:
        return derivatives(data, spectrum.unpack(theta))[1]

    value, slope, information = derivatives(data, spectrum)
    assert value == pytest.approx(contrast(data, spectrum), rel=1e-12)
    numeric = approx_fprime(theta, lambda x: contrast(data, spectrum.unpack(x)), 1e-6)
    assert slope == pytest.approx(numeric, rel=2e-3, abs=1e-3 * np.max(np.abs(numeric)))
    # the rows of the gain are exact second derivatives
    for h in (1e-5,):
        step = np.zeros(theta.size)
        step[GAIN] = h
        row = (gradient(theta + step) - gradient(theta - step)) / (2 * h)
        assert information[GAIN] == pytest.approx(row, rel=1e-4, abs=1e-4 * np.max(np.abs(row)))
    # the others are those of the model where the data are the model
    pure = dataclasses.replace(
        data,
        measured=density(data, spectrum),
        crossed=np.zeros_like(data.crossed),
        corrected=np.zeros_like(data.corrected),
    )
    _, flat, expected = derivatives(pure, spectrum)
    assert flat == pytest.approx(0, abs=1e-8)
    rows = np.array(
        [
            (gradient(theta + h, pure) - gradient(theta - h, pure)) / 2e-5
            for h in 1e-5 * np.eye(theta.size)[1:]
        ]
    )
    assert expected[1:, 1:] == pytest.approx(rows[:, 1:], rel=1e-3, abs=1e-3 * np.max(rows))


@pytest.mark.parametrize("taper", [False, True])
@pytest.mark.parametrize("drift", [False, True])
def test_second_derivatives_of_the_likelihood(drift: bool, taper: bool) -> None:
    """The slope of the table that smears lines has corners: differences see them."""
    data, spectrum = case(drift=drift)
    if not taper:
        data = dataclasses.replace(data, duration_s=None)
    theta, step = spectrum.pack(), 1e-4

    def gradient(change: np.ndarray) -> np.ndarray:
        return derivatives(data, spectrum.unpack(theta + change))[1]

    rows = [(gradient(h) - gradient(-h)) / (2 * step) for h in step * np.eye(theta.size)]
    found = second_derivatives(data, spectrum)
    scale = np.sqrt(np.abs(np.diag(found)))
    assert found / np.outer(scale, scale) == pytest.approx(
        np.array(rows) / np.outer(scale, scale), abs=1e-2 if taper else 1e-4
    )
    assert found == pytest.approx(found.T, rel=1e-12)
