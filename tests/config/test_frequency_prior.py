"""Frequency priors in a configuration."""

from __future__ import annotations

import numpy as np
import pytest
from support.plants import LBT_YAML, lbt_axis_plant
from support.vibration_config import write_vibration

import lbt_synth as lbt


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


def test_priors_of_a_configuration(tmp_path):
    plain = lbt.load_config(LBT_YAML).plant
    for keys, lines in (({"spread_hz": 1.0}, 5), ({"spread_hz": 0.5, "lines": 2}, 2)):
        plant = lbt.load_config(write_vibration(tmp_path, **keys)).plant
        expected = lbt.models.spread_plant(plain, half_width_hz=keys["spread_hz"], lines=lines)
        assert len(plant.vibrations) == 2 * lines
        np.testing.assert_allclose(plant.A, expected.A, rtol=1e-13)
        np.testing.assert_allclose(plant.B, expected.B, rtol=1e-11)
    for keys, text in (
        ({"lines": 3}, r"vibrations\[0\]: lines goes with spread_hz, and only with it"),
        ({"spread_hz": 20.0}, r"model.vibrations\[0\].spread_hz: the half width must be below 20"),
        ({"spread_hz": -1.0}, "greater than 0"),
        ({"spread_hz": 1.0, "lines": 65}, "less than or equal to 64"),
        ({"frequency_hz": 399.0, "spread_hz": 9.0}, r"vibrations\[0\].spread_hz: .*Nyquist"),
    ):
        with pytest.raises(lbt.errors.ConfigError, match=text):
            lbt.load_config(write_vibration(tmp_path, **keys))
