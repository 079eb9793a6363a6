"""Plants that many tests share."""

from __future__ import annotations

import hypothesis
import matplotlib as mpl
import pytest
from plants import LBT_YAML, lbt_axis_plant

import lbt_synth as lbt

mpl.use("Agg")
hypothesis.settings.register_profile("default", deadline=None, derandomize=True, max_examples=40)
hypothesis.settings.load_profile("default")


@pytest.fixture
def axis_plant():
    return lbt_axis_plant()


@pytest.fixture
def air():
    return lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)


@pytest.fixture
def config():
    return lbt.load_config(LBT_YAML)
