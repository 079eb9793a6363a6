"""Runs of a loop in which sensors fail, against the exact answers."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.loop.simulation.disturbances import draw_disturbance, draw_parts
from lbt_synth.loop.simulation.failing_sensors import (
    Drop,
    draw_others,
    run_segments,
    simulate_sensors,
)
from lbt_synth.models.plant.seen_vibration import seen_vibration


def run(design, truth, drops=(), **options):
    """One run of the loop."""
    options = {"frames": 10_000, "cases": 8, "seed": 3, "hardware": design.hardware} | options
    return simulate_sensors(design.controllers, truth, drops=drops, **options)


def exact_nm(design, truth, missing, filtered):
    """The exact residual where some sensors read zero and a filter takes some as missing."""
    controller = design.controllers[frozenset(filtered)]
    loop = lbt.close_loop(design.hardware, controller, blind=missing)
    return lbt.residual_budget(loop, truth, frame_means=True).rms_nm


@pytest.mark.parametrize(
    ("missing", "reading"),
    [((), "missing"), (("m1",), "missing"), (("m2",), "zero"), (("slow", "m2"), "missing")],
)
def test_a_run_has_the_exact_residual(sensors_design, sensors_config, missing, reading):
    drops = [Drop(unit=unit, start_s=0, reading=reading) for unit in missing]
    found = np.sqrt(np.mean(run(sensors_design, sensors_config.truth, drops).rms_nm ** 2))
    filtered = missing if reading == "missing" else ()
    assert found == pytest.approx(
        exact_nm(sensors_design, sensors_config.truth, missing, filtered), rel=0.03
    )


def test_the_wavefront_sensor_may_go_and_come_back(sensors_design, sensors_config):
    away = Drop(unit="wavefront", start_s=3, end_s=3.2)
    found = run(sensors_design, sensors_config.truth, [away])
    untouched = run(sensors_design, sensors_config.truth)
    assert np.array_equal(found.residual_nm[:, :3000], untouched.residual_nm[:, :3000])
    apart = np.abs(found.residual_nm - untouched.residual_nm)
    assert np.max(apart[:, 3000:3200]) > 20
    assert np.max(apart[:, 9000:]) < 1e-6  # what it left has decayed
    steps = np.abs(np.diff(found.commands, axis=1))
    # no jump of the commands where filters are switched
    assert np.max(steps[:, 2998:3003]) < 2 * np.max(steps[:, :2990])


def test_a_frozen_wavefront_runs_away_where_the_table_says_so(sensors_design, sensors_config):
    away = Drop(unit="wavefront", start_s=1, reading="frozen")
    loop = lbt.close_loop(sensors_design.hardware, sensors_design.controller, blind=("wavefront",))
    found = run(sensors_design, sensors_config.truth, [away], frames=6000, cases=2)
    grows = np.max(np.abs(found.residual_nm[:, -100:])) > 1e4
    assert grows == (not loop.is_stable)


def test_a_sinusoid_that_channels_see(sensors_design, sensors_config):
    lines = tuple(
        lbt.models.SinusoidalVibration(frequency_hz=f, rms_nm=100, direction=d)
        for f, d in ((20, (1, 0)), (33, (0, 1)))
    )
    truth = replace(sensors_config.truth, vibrations=lines)
    loop = sensors_design.close(sensors_config.hardware)
    exact = lbt.residual_budget(loop, truth, frame_means=True)
    found = run(sensors_design, truth, frames=20_000, cases=4)
    assert np.sqrt(np.mean(found.rms_nm**2)) == pytest.approx(exact.rms_nm, rel=0.03)


def path_with(channel):
    """A loop at 800 Hz whose accelerometer is another sensor."""
    suite = lbt.models.SensorSuite(sensors=(channel,))
    return lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, modes=1, suite=suite)


@pytest.mark.parametrize(("period", "delay_frames"), [(1, 1.3), (2, 1.6)])
def test_readings_and_phase_of_a_run_are_those_of_one_oscillator(period, delay_frames):
    """Where exposures end within a frame; the positions are drawn without knowing of it."""
    line = lbt.Vibration(frequency_hz=60, damping=0.1, rms_nm=100, direction=(1,))
    channel = lbt.models.Accelerometer(
        name="mirror",
        rate_hz=800 / period,
        delay_frames=delay_frames,
        channels=("m1",),
        noise_m_s2=1e-9,
    )
    path = path_with(channel)
    motion = {"m1": lbt.models.Motion(size=1, phase_deg=50)}
    truth = lbt.Truth(turbulence=None, vibrations=(line,), motions=(motion,))
    size = {"frames": 20_000, "cases": 4}
    rng = np.random.default_rng(4)
    _, drawn = draw_parts(truth, path, rng=rng, oscillators=True, **size)
    read = draw_others(truth, path, drawn, rng, zero_frame=0, **size)[:, 100::period, 0]
    both = np.stack([drawn[0].motion[:, 100::period].ravel(), read.ravel()])
    expected = seen_vibration(line, motion, (channel,), path).output_covariances()[0]
    sizes = np.sqrt(np.diag(expected))
    found = np.cov(both) / np.outer(sizes, sizes)
    np.testing.assert_allclose(found, expected / np.outer(sizes, sizes), atol=0.03)
    same = draw_disturbance(truth, path, rng=np.random.default_rng(4), oscillators=True, **size)
    np.testing.assert_array_equal(same[:, :, 0], drawn[0].motion)


def test_a_line_that_drifts_is_read_at_its_frequency_of_the_moment():
    line = lbt.models.DriftingVibration(
        start_hz=40, end_hz=80, duration_s=10, rms_nm=100, direction=(1,)
    )
    channel = lbt.models.Accelerometer(
        name="mirror", rate_hz=800, delay_frames=2.5, channels=("m1",), noise_m_s2=1e-12
    )
    path = path_with(channel)
    motion = {"m1": lbt.models.Motion(size=2, phase_deg=70)}
    truth = lbt.Truth(turbulence=None, vibrations=(line,), motions=(motion,))
    size = {"frames": 8000, "cases": 1, "zero_frame": 0}
    _, drawn = draw_parts(truth, path, rng=np.random.default_rng(4), **size)
    read = draw_others(truth, path, drawn, np.random.default_rng(5), **size)[0, :, 0]
    time_s = np.arange(8000) / 800
    wave = np.exp(2j * np.pi * line.turns_at(time_s - 1.5 / 800))
    start = np.random.default_rng(4).spawn(2)[1].uniform(0, 2 * np.pi)
    size_m_s2 = 1e-9 * (2 * np.pi * line.frequency_hz_at(time_s)) ** 2 * line.amplitude_nm
    expected = np.real(-size_m_s2 * motion["m1"].factor * wave * np.exp(1j * start))
    assert np.abs(read - expected)[5:].max() < 2e-3 * np.abs(expected).max()


def test_segments_of_drops_that_overlap():
    drops = [Drop(unit="a", start_s=1, end_s=3), Drop(unit="b", start_s=2, reading="zero")]
    found = run_segments(drops, 4.0)
    assert [(s.start_s, s.end_s, s.text) for s in found] == [
        (0, 1, ""),
        (1, 2, "a"),
        (2, 3, "a, b (zero)"),
        (3, 4, "b (zero)"),
    ]


def test_a_sensor_that_is_not_there(sensors_design, sensors_config):
    with pytest.raises(ProblemError, match="must be one of wavefront, slow, m1, m2; got 'm3'"):
        run(sensors_design, sensors_config.truth, [Drop(unit="m3", start_s=0)], frames=10)


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
