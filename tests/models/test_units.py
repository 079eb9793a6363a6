"""Units of tip and tilt."""

from __future__ import annotations

import pytest

import lbt_synth as lbt


def test_one_mas_is_a_quarter_of_the_diameter():
    assert lbt.models.nm_per_mas(8.22) == pytest.approx(9.963, abs=5e-4)
