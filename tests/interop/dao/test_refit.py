"""Controllers made again for coarse arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.interop.dao import refit
from lbt_synth.interop.dao.export import direct_form_rows
from lbt_synth.interop.dao.mode_loop import shaped_mode_loop


@pytest.fixture(scope="module")
def case(shaped):
    rows = direct_form_rows(shaped.controller, 20)[:, 0]
    return shaped_mode_loop(shaped.hardware, shaped.specifications[0], 20), rows


def test_sections_give_back_the_coefficients(case):
    loop, c = case
    wide = refit._widened(loop, c)
    found = refit._coefficients(loop, refit._sections(loop, wide))
    assert found == pytest.approx(wide, abs=1e-9)


def test_a_common_factor_leaves_the_loop_as_it_is(case):
    loop, c = case
    wide = refit._widened(loop, c)
    assert loop.residuals_nm(wide) == pytest.approx(loop.residuals_nm(c), rel=1e-6)
    assert loop.rounding_nm(wide)[0] < 0.2 * loop.rounding_nm(c)[0]


def test_slopes_are_those_of_finite_differences(case):
    """Without the rounding, whose memory counts as constant; and of it alone."""
    loop, c = case
    theta = refit._sections(loop, refit._widened(loop, c))
    targets = refit._targets(loop, c)
    weights = refit._Weights(np.ones(2), 0.0, 3.0, 0.92)
    before, slopes = refit._rows(loop, targets, theta, weights)
    for k in range(0, theta.size, 5):
        step = np.zeros(theta.size)
        step[k] = 1e-7
        up, down = (refit._rows(loop, targets, theta + s, weights)[0] for s in (step, -step))
        scale = np.max(np.abs(slopes[:, k]))
        assert (up - down) / 2e-7 == pytest.approx(slopes[:, k], abs=1e-4 * scale)
    assert np.all(np.isfinite(before))


def test_a_loop_that_coarse_arithmetic_breaks_is_mended(case):
    loop, c = case
    own = loop.residuals_nm(c)
    before = np.hypot(own, loop.rounding_nm(c)) / own
    found = refit.refit(loop, c)
    after = np.hypot(loop.residuals_nm(found), loop.rounding_nm(found)) / own
    assert np.min(before) > 5
    assert np.max(after) < 1.01
    assert loop.radius(found, np.linspace(0.5, 1.2, 50)) < 1
