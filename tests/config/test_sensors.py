"""Sensors beside the loop's own, in a configuration."""

import numpy as np
import pytest
from support.several_sensors import CONFIG, write_config

import lbt_synth as lbt
from lbt_synth.errors import ConfigError


def load(tmp_path, *edits):
    """The configuration with parts of its text replaced."""
    text = CONFIG
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    return lbt.load_config(write_config(tmp_path, text))


def test_a_file_describes_its_sensors(sensors_config):
    plant = sensors_config.plant
    assert plant.hardware.suite.units == ("wavefront", "slow", "m1", "m2")
    assert plant.period == 2
    assert plant.read.tolist() == [[True] * 6, [True, True, False, False, True, True]]
    assert plant.motions[1]["m2"].phase_deg == 150
    assert sensors_config.truth.motions == plant.motions


def test_the_own_sensor_among_the_others(tmp_path, sensors_config):
    own = "  wavefront: {rate_hz: 1000, delay_frames: 2, noise_nm: 75}\n"
    written = load(
        tmp_path,
        ("loop: {frame_rate_hz: 1000, delay_frames: 2, axes: 2}\nsensor: {noise_nm: 75}\n", ""),
        ("sensors:\n", f"sensors:\n{own}"),
    )
    assert written.plant.hardware.suite.units == sensors_config.plant.hardware.suite.units
    assert np.array_equal(written.plant.A, sensors_config.plant.A)
    assert np.array_equal(written.plant.C, sensors_config.plant.C)


def test_the_own_sensor_alone_is_the_loop(tmp_path):
    text = CONFIG[: CONFIG.index("loop:")] + "sensors: {wavefront: {rate_hz: 500, noise_nm: 9}}\n"
    text += "model: {turbulence: {kind: ar, coefficients: [0.9], driving_rms_nm: 5}}\n"
    config = lbt.load_config(write_config(tmp_path, text))
    assert config.plant.hardware.suite.units == ("wavefront",)
    assert config.hardware.frame_rate_hz == 500


def test_lines_of_the_truth_name_their_channels(tmp_path):
    line = "{axis: tip, kind: sinusoid, frequency_hz: 21, rms_nm: 400, accelerometers: {m1: {motion_nm_per_nm: 3}}}"
    config = load(tmp_path, ("truth: {vibrations: model}", f"truth: {{vibrations: [{line}]}}"))
    assert config.truth.motions[0]["m1"].size == 3


def test_a_spread_line_moves_its_channels_with_each_of_its_lines(tmp_path):
    config = load(
        tmp_path,
        (
            "frequency_hz: 20, damping: 0.01",
            "frequency_hz: 20, spread_hz: 1, lines: 3, damping: 0.01",
        ),
    )
    motions = config.plant.motions
    assert [sorted(motion) for motion in motions] == [["m1"], ["m1"], ["m1"], ["m2"]]


def test_correlated_noise(tmp_path):
    config = load(
        tmp_path, ("noise_m_s2: 2.0e-4", "covariance: [[4.0e-8, 2.0e-8], [2.0e-8, 4.0e-8]]")
    )
    factor = config.plant.hardware.suite.accelerometers[0].noise_factor(2)
    assert np.allclose(factor @ factor.T, [[4e-8, 2e-8], [2e-8, 4e-8]])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rate_hz: 500", "rate_hz: 300", "whole multiple"),
        ("delay_frames: 2.5", "delay_frames: 1", "at least 1.5"),
        ("channels: [m1, m2]", "channels: [m1, m1]", "different names"),
        ("channels: [m1, m2]", "channels: [m1, wavefront]", "different names"),
        ("channels: [m1, m2]", "channels: [m1]", "names the channel 'm2'"),
        ("noise_m_s2: 2.0e-4", "noise_nm: 2", "goes with kind: wavefront"),
        (", noise_nm: 20}", "}", "exactly one of noise_nm, covariance"),
        ("channels: [m1, m2], ", "", "names of its channels"),
        ("{rate_hz: 500, delay", "{rate: 500, delay", "unknown key sensors.slow.rate"),
        ("  slow: {rate_hz: 500,", "  wavefront: {rate_hz: 500,", "frame_rate_hz 1000"),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, said):
    with pytest.raises(ConfigError, match=said):
        load(tmp_path, (old, new))


def test_a_horizon_makes_all_sensors_later(sensors_config):
    hardware = sensors_config.design("kalman", horizon=2).hardware
    assert hardware.delay_frames == 3
    assert [sensor.delay_frames for sensor in hardware.suite.sensors] == [3.0, 2.0]


def test_methods_for_the_own_sensor_leave_the_others_out(sensors_config):
    design = sensors_config.design("integrator", gain=0.3)
    assert design.controller.D.shape == (2, 2)
    assert design.assumptions == ("the loop's own sensor is read alone, without slow, m1, m2",)
