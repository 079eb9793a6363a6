"""The loop of one mode around a direct form, against the package's own loops and a simulation."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.interop.dao.direct_form import direct_form, direct_form_rows
from lbt_synth.interop.dao.mode_loop import ROUNDING, shaped_mode_loop
from lbt_synth.interop.dao.refit import _widened
from lbt_synth.interop.written_loop import _rounding_left
from lbt_synth.loop.closed_loop import radii_by_gain


@pytest.fixture(scope="module")
def case(shaped):
    rows = direct_form_rows(shaped.controller, 20)[:, 0]
    return shaped_mode_loop(shaped.hardware, shaped.specifications[0], 20), rows


def test_residuals_are_those_of_the_design(case, shaped):
    loop, c = case
    (specification,) = shaped.specifications
    expected = []
    for s in loop.scenarios:
        around = lbt.close_loop(shaped.hardware, shaped.controller, sensor_gain=s.sensor_gain)
        air, line, *_ = specification.objective.terms
        truth = lbt.Truth(
            turbulence=air.turbulence, noise_nm=air.noise_nm, sensor_gain=s.sensor_gain
        )
        budget = lbt.residual_budget(around, truth)
        expected.append(np.hypot(budget.rms_nm, line.rms_nm * line.peak(around.rejection())))
    assert [s.sensor_gain for s in loop.scenarios] == [1.0, 0.6]
    assert loop.residuals_nm(c) == pytest.approx(expected, rel=2e-3)


def test_radius_is_that_of_the_loop(case, shaped):
    loop, c = case
    gains = np.array([0.5, 0.9, 1.2])
    expected = np.max(radii_by_gain(shaped.hardware, shaped.controller)(gains))
    assert loop.radius(c, gains) == pytest.approx(expected, rel=1e-6)
    assert (loop.low, loop.high) == (0.5, 1.2)


def test_sums_are_as_large_as_in_a_simulation(case):
    """White measurements into an FIR filter have known partial sums; the loop's are simulated."""
    loop, c = case
    rng = np.random.default_rng(2)
    scenario = loop.scenarios[0]
    b, a = c[:21], c[21:]
    frames = 40_000
    air = np.zeros(frames)
    for k in range(1, frames):
        air[k] = 0.99 * air[k - 1] + 40 * rng.standard_normal()
    line = np.sqrt(2) * 100 * np.cos(2 * np.pi * 20 / 800 * np.arange(frames))
    y, u = np.zeros((2, frames + 21))
    squares = np.zeros(2)
    residual = 0.0
    for k in range(frames):
        y[k + 20] = residual + 20 * rng.standard_normal()
        terms = np.concatenate([b * y[k : k + 21][::-1], a * u[k : k + 20][::-1]])
        u[k + 20] = terms.sum()
        residual = air[k] + line[k] - u[k + 19]
        squares += np.sum(terms**2), np.sum(np.cumsum(terms)[1:] ** 2)
    expected = ROUNDING * squares.sum() / frames
    assert loop.sums_nm2(c, scenario.sensor_gain) == pytest.approx(expected, rel=0.15)


def test_rounding_in_the_loop_is_that_of_the_lyapunov_equation(case, shaped):
    """Noise that enters with the command, through the state-space loop.

    A factor common to both polynomials keeps the state-space loop well conditioned.
    """
    loop, own = case
    c = _widened(loop, own)
    added = np.concatenate([np.eye(21)[0], c[21:]])
    written, entry = (direct_form(x[:, None], shaped.controller.dt_s) for x in (c, added))
    variance = np.array([loop.sums_nm2(c, 1.0)])
    left = _rounding_left(shaped.hardware, written, entry, variance, 1.0)
    assert loop.rounding_nm(c)[0] == pytest.approx(np.sqrt(left[0]), rel=2e-3)


def test_slopes_are_relative_changes_of_the_loops_polynomial(case):
    loop, own = case
    c = _widened(loop, own)
    step = np.zeros_like(c)
    step[[3, 30]] = 1e-9, -2e-9
    found = loop.slopes(c) @ step
    expected = []
    for gain in {1.0, loop.low, loop.high, *(s.sensor_gain for s in loop.scenarios)}:
        before, after = (loop.polynomials(x, gain)[2] for x in (c, c + step))
        expected.append(after / before - 1)  # about 1e-3 of rounding
    both = np.concatenate(expected)
    assert found == pytest.approx(np.concatenate([both.real, both.imag]), rel=1e-3, abs=1e-12)
