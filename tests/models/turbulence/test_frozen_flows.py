"""Many frozen flows against single atmospheres."""

from dataclasses import replace

import numpy as np
import pytest
from support.ensembles import AIR, weather

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.turbulence.frozen_flows import _octave_splines


def test_flows_are_those_of_single_atmospheres():
    w = weather(8, seed=7)
    f = np.geomspace(1e-5, 399, 300)
    flows = lbt.models.FrozenFlows(
        atmosphere=AIR,
        seeing_arcsec=w["seeing"],
        wind_speed_m_s=w["wind"],
        outer_scale_m=[22.0, 30.0] * 4,
    )
    for i, psd in enumerate(flows.psd(f)):
        single = replace(
            AIR,
            seeing_arcsec=w["seeing"][i],
            wind_speed_m_s=w["wind"][i],
            outer_scale_m=[22.0, 30.0][i % 2],
        )
        assert psd == pytest.approx(single.psd(f), rel=1e-11)
    assert flows.take(np.array([3])).psd(f)[0] == pytest.approx(flows.psd(f)[3], rel=1e-12)


def test_flows_of_many_outer_scales():
    """More scales than have tables of their own: a polynomial over each octave."""
    scales = np.geomspace(16.5, 31.5, 20)
    f = np.geomspace(1e-4, 399, 100)
    found = lbt.models.FrozenFlows(atmosphere=AIR, outer_scale_m=scales).psd(f)
    for i in (0, 7, 19):
        single = replace(AIR, outer_scale_m=float(scales[i])).psd(f)
        assert found[i] == pytest.approx(single, rel=1e-9)
    assert _octave_splines.cache_info().currsize >= 1


def test_kolmogorov_flows():
    air = replace(AIR, outer_scale_m=None)
    flows = lbt.models.FrozenFlows(atmosphere=air, wind_speed_m_s=[10.0, 20.0])
    assert flows.psd([3.0])[1, 0] == pytest.approx(air.psd(3.0), rel=1e-12)
    assert flows.take(np.array([0])).psd([3.0])[0, 0] == pytest.approx(
        replace(air, wind_speed_m_s=10).psd(3.0), rel=1e-12
    )


def test_what_is_no_flow():
    for given, kind, words in (
        ({"seeing_arcsec": [0.5, 0.0]}, ProblemError, "seeing_arcsec must be above 0"),
        (
            {"seeing_arcsec": [0.5, 0.6], "wind_speed_m_s": [1, 2, 3]},
            DimensionError,
            "same length",
        ),
        ({"wind_speed_m_s": [[1.0]]}, DimensionError, "lists, one number per loop"),
    ):
        with pytest.raises(kind, match=words):
            lbt.models.FrozenFlows(atmosphere=AIR, **given)
    with pytest.raises(ProblemError, match="above 0 Hz"):
        lbt.models.FrozenFlows(atmosphere=AIR).psd([0.0])
