"""Controllers made again for single precision: their loop, the search, and the rounding."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.interop.dao import refit
from lbt_synth.interop.dao.export import direct_form, direct_form_rows
from lbt_synth.interop.dao.refit import ROUNDING, _widened, mode_loop, round_together
from lbt_synth.interop.proof import _rounding_left
from lbt_synth.loop.stable_range import radii_by_gain


@pytest.fixture(scope="module")
def case(shaped):
    rows = direct_form_rows(shaped.controller, 20)[:, 0]
    return mode_loop(shaped.hardware, shaped.specifications[0], 20), rows


def rounding_nm(loop, c):
    """What the arithmetic adds in each scenario."""
    return np.sqrt(loop.residuals_nm(c, rounding=True) ** 2 - loop.residuals_nm(c) ** 2)


def test_residuals_are_those_of_the_design(case, shaped):
    loop, c = case
    (specification,) = shaped.specifications
    expected = []
    for gain in loop.gains:
        around = lbt.close_loop(shaped.hardware, shaped.controller, sensor_gain=gain)
        air, line, *_ = specification.objective.terms
        truth = lbt.Truth(turbulence=air.turbulence, noise_nm=air.noise_nm, sensor_gain=gain)
        budget = lbt.residual_budget(around, truth, frame_means=True)
        expected.append(np.hypot(budget.rms_nm, line.rms_nm * line.peak(around.rejection())))
    assert loop.gains == (1.0, 0.6)
    assert loop.residuals_nm(c) == pytest.approx(expected, rel=2e-3)


def test_radius_is_that_of_the_loop(case, shaped):
    loop, c = case
    gains = np.append(np.geomspace(0.5, 1.2, 25), 1.0)
    expected = np.max(radii_by_gain(shaped.hardware, shaped.controller)(gains))
    assert loop.radius(c) == pytest.approx(expected, rel=1e-6)
    assert (loop.low, loop.high) == (0.5, 1.2)


def test_sums_are_as_large_as_in_a_simulation(case):
    """White measurements into an FIR filter have known partial sums; the loop's are simulated."""
    loop, c = case
    rng = np.random.default_rng(2)
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
    assert loop.sums_nm2(c, loop.gains[0]) == pytest.approx(expected, rel=0.15)


def test_rounding_in_the_loop_is_that_of_the_lyapunov_equation(case, shaped):
    """Noise that enters with the command, through the state-space loop.

    A factor common to both polynomials keeps the state-space loop well conditioned.
    """
    loop, own = case
    c = _widened(own)
    added = np.concatenate([np.eye(21)[0], c[21:]])
    written, entry = (direct_form(x[:, None], shaped.controller.dt_s) for x in (c, added))
    variance = np.array([loop.sums_nm2(c, 1.0)])
    left = _rounding_left(shaped.hardware, written, entry, variance, 1.0)
    assert rounding_nm(loop, c)[0] == pytest.approx(np.sqrt(left[0]), rel=2e-3)


def test_sections_give_back_the_coefficients(case):
    wide = _widened(case[1])
    assert refit._coefficients(refit._sections(wide)) == pytest.approx(wide, abs=1e-9)


def test_a_common_factor_leaves_the_loop_as_it_is(case):
    loop, c = case
    wide = _widened(c)
    assert loop.residuals_nm(wide) == pytest.approx(loop.residuals_nm(c), rel=1e-6)
    assert rounding_nm(loop, wide)[0] < 0.2 * rounding_nm(loop, c)[0]


def test_slopes_are_those_of_finite_differences(case):
    """Without the rounding, whose memory counts as constant."""
    loop, c = case
    loop = replace(loop, shares=np.zeros_like(loop.shares))
    theta = refit._sections(_widened(c))
    shares = 1 / loop.residuals_nm(c)
    limits = refit._limits(loop, c)
    before, slopes = refit._rows(loop, shares, limits, theta)
    for k in range(0, theta.size, 5):
        step = np.zeros(theta.size)
        step[k] = 1e-5
        up, down = (refit._rows(loop, shares, limits, theta + s)[0] for s in (step, -step))
        scale = np.max(np.abs(slopes[:, k]))
        smooth = (up == 0) == (down == 0)  # but for limits that are passed in between
        found, expected = (up - down)[smooth] / 2e-5, slopes[smooth, k]
        assert found == pytest.approx(expected, abs=1e-4 * scale)
        assert np.mean(smooth) > 0.999
    assert np.all(np.isfinite(before))


def test_a_loop_that_coarse_arithmetic_breaks_is_mended(case):
    loop, c = case
    allowed_nm = loop.residuals_nm(c)
    before = loop.residuals_nm(c, rounding=True) / allowed_nm
    found = refit.refit(loop, c)
    after = loop.residuals_nm(found, rounding=True) / allowed_nm
    assert np.min(before) > 5
    assert np.max(after) < 1.01
    assert loop.radius(found) < 1
    rounded = round_together(loop, found).astype(np.float64)
    assert loop.residuals_nm(rounded, rounding=True) == pytest.approx(after * allowed_nm, rel=5e-3)


def test_errors_of_rounding_cancel_where_they_count(case):
    """Against rounding one by one, by what each changes of the loop's polynomial."""
    loop, own = case
    c = _widened(own)
    rounded = round_together(loop, c)
    assert rounded.dtype == np.float32
    assert np.any(own == 0)
    assert np.all(round_together(loop, own)[own == 0] == 0)

    def change(near):
        gains = (1.0, loop.low, loop.high, *loop.gains)
        pairs = [[loop.polynomials(x, gain)[2] for x in (near.astype(float), c)] for gain in gains]
        return np.linalg.norm([after / before - 1 for after, before in pairs])

    assert change(rounded) < 0.1 * change(c.astype(np.float32))
