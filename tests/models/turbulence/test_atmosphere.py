"""The tilt of von Karman turbulence, against published numbers and adaptive quadrature."""

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.integrate import quad, trapezoid
from scipy.special import jv
from support.ensembles import AIR, weather
from support.refusals import require_refusals

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.turbulence.atmosphere import _octave_of_splines


def test_tilt_of_the_lbt(air):
    assert air.fried_parameter_m == pytest.approx(0.1258, abs=1e-4)
    assert air.tilt_rms_nm == pytest.approx(591.7, abs=0.5)
    assert replace(air, obstruction=0.11).tilt_rms_nm == pytest.approx(595.3, abs=0.5)
    f = np.geomspace(1e-5, 400, 100_001)
    assert trapezoid(air.psd(f), f) == pytest.approx(air.tilt_rms_nm**2, rel=2e-3)


def test_tilt_spectrum_between_the_points_of_its_table(air):
    """By adaptive quadrature over the other spatial frequency."""
    r0, D, V = air.fried_parameter_m, air.diameter_m, air.wind_speed_m_s
    scale = 0.0228956 * r0 ** (-5 / 3) * (500 / (2 * np.pi)) ** 2

    def spatial(fy, fx):
        f = np.hypot(fx, fy)
        tilt = 2 * (4 * jv(2, np.pi * D * f) / (2 * np.pi * D * f)) ** 2
        return scale * (f**2 + 22.0**-2) ** (-11 / 6) * tilt

    edges = np.concatenate([[0], np.geomspace(1e-3, 40, 60)]) / D
    # those between two points of the table, in units of V / D
    for f in np.array([0.011, 0.27, 0.8137, 1.9371, 4.4417, 9.97]) * V / D:
        panels = itertools.pairwise(edges)
        total = sum(quad(spatial, *ends, args=(f / V,), limit=200)[0] for ends in panels)
        assert air.psd(f) == pytest.approx(4 / V * total, rel=2e-5)


def test_flows_are_those_of_single_atmospheres():
    w, f = weather(4, seed=7), np.geomspace(1e-5, 399, 300)
    columns = {"seeing_arcsec": w["seeing"], "wind_speed_m_s": w["wind"]}
    columns["outer_scale_m"] = [22.0, 30.0] * 2
    flows = replace(AIR, **columns)
    for psd, *numbers in zip(flows.psd(f), *columns.values(), strict=True):
        single = replace(AIR, **dict(zip(columns, numbers, strict=True)))
        assert psd == pytest.approx(single.psd(f), rel=1e-11)
    assert flows.take(np.array([3])).psd(f)[0] == pytest.approx(flows.psd(f)[3], rel=1e-12)
    endless = replace(AIR, outer_scale_m=None)
    alone = [replace(endless, wind_speed_m_s=v).psd(3.0) for v in (10, 20)]
    both = replace(endless, wind_speed_m_s=[10.0, 20.0]).psd([3.0])
    assert both[:, 0] == pytest.approx(np.array(alone), rel=1e-12)


def test_flows_of_many_outer_scales():
    """More scales than have tables of their own: a polynomial over each octave."""
    scales, f = np.geomspace(16.5, 31.5, 20), np.geomspace(1e-4, 399, 100)
    psd = replace(AIR, outer_scale_m=scales).psd(f)
    for i in (0, 7, 19):
        single = replace(AIR, outer_scale_m=float(scales[i])).psd(f)
        assert psd[i] == pytest.approx(single, rel=1e-9)
    assert _octave_of_splines.cache_info().currsize >= 1


def test_what_is_no_flow():
    flow, uneven = partial(replace, AIR), {"seeing_arcsec": [0.5, 0.6], "wind_speed_m_s": [1, 2, 3]}
    rows = [
        (partial(flow, seeing_arcsec=[0.5, 0.0]), ProblemError, "seeing_arcsec must be above 0"),
        (partial(flow, **uneven), DimensionError, "same length"),
        (partial(flow, wind_speed_m_s=[[1.0]]), DimensionError, "lists of the same length"),
        (partial(AIR.psd, [-1.0]), ProblemError, "at least 0; got -1"),
    ]
    require_refusals(rows)
