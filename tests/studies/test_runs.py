"""Runs in which sensors fail."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.loop.simulation import Drop
from lbt_synth.studies.runs import run_design


def test_each_segment_has_its_exact_residual(sensors_design, sensors_config):
    drops = [Drop(unit="m1", start_s=3), Drop(unit="m2", start_s=6, reading="zero")]
    loop = "several", sensors_design, sensors_config.truth, sensors_config
    segments = run_design(*loop, drops=drops, frames=9000, cases=6, seed=4).segments
    rows = [row for _, row in segments]
    assert [row.sensors for row in rows] == ["none", "m1", "m1, m2 (zero)"]
    loop = lbt.close_loop(sensors_design.hardware, sensors_design)
    assert rows[0].exact_nm == pytest.approx(
        lbt.residual_budget(loop, sensors_config.truth).rms_nm, rel=1e-9
    )
    for row in rows:
        assert row.residual_nm == pytest.approx(row.exact_nm, rel=0.06)
    assert rows[0].strehl > rows[1].strehl > rows[2].strehl


def test_a_loop_that_a_blind_sensor_destabilises_has_no_exact_answer(
    sensors_design, sensors_config
):
    away = Drop(unit="wavefront", start_s=0.5, reading="zero")
    slow = Drop(unit="slow", start_s=0.5, reading="missing")
    loop = "several", sensors_design, sensors_config.truth, sensors_config
    segments = run_design(*loop, drops=[away, slow], frames=600, cases=1, seed=4).segments
    (_, first), (_, last) = segments
    stable = np.isfinite(last.exact_nm)
    assert first.stable
    assert last.stable == np.isfinite(last.strehl) == stable
    radius = sensors_design.controllers[frozenset({"slow"})].to_statespace().radius_per_frame
    assert stable == (radius < 1)  # nothing closes the loop: the controller alone decides


def test_a_frozen_reading_and_a_drift_have_no_exact_answer(sensors_design, sensors_config):
    frozen = [Drop(unit="m1", start_s=0.5, reading="frozen")]
    size = {"frames": 600, "cases": 1, "seed": 4}
    loop = "several", sensors_design, sensors_config.truth, sensors_config
    segments = run_design(*loop, drops=frozen, **size).segments
    assert [np.isfinite(row.exact_nm) for _, row in segments] == [True, False]
    assert all(row.stable for _, row in segments)
    line, *others = sensors_config.truth.vibrations
    moving = lbt.models.SinusoidalVibration(
        frequency_hz=line.frequency_hz,
        end_hz=line.frequency_hz + 0.1,
        duration_s=1,
        rms_nm=line.rms_nm,
        direction=line.direction,
    )
    drifting = replace(sensors_config.truth, vibrations=(moving, *others))
    ((_, row),) = run_design(*loop[:2], drifting, sensors_config, **size).segments
    assert (np.isfinite(row.exact_nm), row.stable) == (False, True)
