"""Runs of a loop in which sensors fail, against the exact answers."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.loop.fusion.fused_loop import close_fused_loop
from lbt_synth.loop.fusion.simulation import Drop, run_segments, simulate_fused


def run(fused, config, drops=(), **options):
    """One run of the loop."""
    sizes = {"frames": 10_000, "cases": 8, "seed": 3} | options
    return simulate_fused(
        fused.controllers,
        fused.problem.suite,
        config.truth,
        hardware=config.hardware,
        drops=drops,
        **sizes,
    )


def exact_nm(fused, config, missing, filtered):
    """The exact residual where some sensors read zero and a filter takes some as missing."""
    loop = close_fused_loop(
        config.hardware, fused.problem.suite, fused.controllers[frozenset(filtered)], blind=missing
    )
    return lbt.residual_budget(loop, config.truth).rms_nm


@pytest.mark.parametrize(
    ("missing", "reading"),
    [((), "missing"), (("m1",), "missing"), (("m2",), "zero"), (("slow", "m2"), "missing")],
)
def test_a_run_has_the_exact_residual(fused, fused_config, missing, reading):
    drops = [Drop(unit=unit, start_s=0, reading=reading) for unit in missing]
    found = np.sqrt(np.mean(run(fused, fused_config, drops).rms_nm ** 2))
    filtered = missing if reading == "missing" else ()
    assert found == pytest.approx(exact_nm(fused, fused_config, missing, filtered), rel=0.03)


def test_the_wavefront_sensor_may_go_and_come_back(fused, fused_config):
    away = Drop(unit="wavefront", start_s=3, end_s=3.2)
    found = run(fused, fused_config, [away])
    untouched = run(fused, fused_config)
    assert np.array_equal(found.residual_nm[:, :3000], untouched.residual_nm[:, :3000])
    apart = np.abs(found.residual_nm - untouched.residual_nm)
    assert np.max(apart[:, 3000:3200]) > 20
    assert np.max(apart[:, 9000:]) < 1e-6  # what it left has decayed
    steps = np.abs(np.diff(found.commands, axis=1))
    # no jump of the commands where filters are switched
    assert np.max(steps[:, 2998:3003]) < 2 * np.max(steps[:, :2990])


def test_a_frozen_wavefront_runs_away_where_the_table_says_so(fused, fused_config):
    away = Drop(unit="wavefront", start_s=1, reading="frozen")
    loop = close_fused_loop(
        fused_config.hardware, fused.problem.suite, fused.controller, blind=("wavefront",)
    )
    found = run(fused, fused_config, [away], frames=6000, cases=2)
    grows = np.max(np.abs(found.residual_nm[:, -100:])) > 1e4
    assert grows == (not loop.is_stable)


def test_a_sinusoid_that_channels_see(fused, fused_config):
    lines = tuple(
        lbt.models.SinusoidalVibration(frequency_hz=f, rms_nm=100, direction=d)
        for f, d in ((20, (1, 0)), (33, (0, 1)))
    )
    truth = replace(fused_config.truth, vibrations=lines)
    exact = lbt.residual_budget(fused.loop(), truth)
    found = simulate_fused(
        fused.controllers,
        fused.problem.suite,
        truth,
        hardware=fused_config.hardware,
        frames=20_000,
        cases=4,
    )
    assert np.sqrt(np.mean(found.rms_nm**2)) == pytest.approx(exact.rms_nm, rel=0.03)


def test_segments_of_drops_that_overlap():
    drops = [Drop(unit="a", start_s=1, end_s=3), Drop(unit="b", start_s=2, reading="zero")]
    found = run_segments(drops, 4.0)
    assert [(s.start_s, s.end_s, s.text) for s in found] == [
        (0, 1, ""),
        (1, 2, "a"),
        (2, 3, "a, b (zero)"),
        (3, 4, "b (zero)"),
    ]


def test_a_sensor_that_is_not_there(fused, fused_config):
    with pytest.raises(ProblemError, match="must be one of wavefront, slow, m1, m2; got 'm3'"):
        run(fused, fused_config, [Drop(unit="m3", start_s=0)], frames=10)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"start_s": 2, "end_s": 1}, "must be back after it fails"),
        ({"start_s": 0, "reading": "odd"}, "missing, zero, frozen"),
        ({"start_s": -1}, "at least 0"),
    ],
)
def test_wrong_drops(fields, said):
    with pytest.raises(ProblemError, match=said):
        Drop(unit="m1", **fields)
