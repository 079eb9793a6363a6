"""Plant, truth, sensors and end-to-end simulation that a configuration describes."""

from pathlib import Path

import numpy as np
import pytest
from support.configs import AR, OTHER, SMALL, change_key, minimal_config, write_config
from support.drifting import drift_file
from support.end_to_end import CONFIG as END_TO_END
from support.plants import LBT_YAML, ROOT
from support.several_sensors import CONFIG as SENSORS
from support.several_sensors import write_config as write_sensors
from support.vibration_config import write_vibration

import lbt_synth as lbt
from lbt_synth.errors import ConfigError
from lbt_synth.models import DriftingVibration
from lbt_synth.studies.robustness import mirror_rows

SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"
LINES = [
    {"kind": "sinusoid", "frequency_hz": 0.3, "rms_nm": 400, "axis": "both"},
    {"kind": "sinusoid", "frequency_hz": 40.0, "rms_nm": 50, "axis": "tip"},
]


def test_every_kind_of_turbulence_and_noise(tmp_path):
    ar2 = lbt.load_config(
        write_config(tmp_path, change_key(("model", "turbulence"), {"kind": "ar2"}))
    )
    assert ar2.plant.turbulence[0].coefficients == pytest.approx([1.99747, -0.99755], abs=1e-4)
    given = {"kind": "ar", "coefficients": [0.9, 0.05], "driving_rms_nm": 3.0}
    ar = lbt.load_config(write_config(tmp_path, change_key(("model", "turbulence"), given)))
    assert ar.plant.turbulence[0].coefficients.tolist() == [0.9, 0.05]
    mas = lbt.load_config(write_config(tmp_path, change_key(("sensor",), {"noise_mas": 2.0})))
    assert mas.noise_nm == pytest.approx(2 * lbt.models.nm_per_mas(8.22))


def test_directions(tmp_path):
    line = {"direction_deg": 30.0, "frequency_hz": 20.0, "damping": 0.01, "rms_nm": 5.0}
    config = lbt.load_config(write_config(tmp_path, change_key(("model", "vibrations"), [line])))
    assert config.plant.vibrations[0].direction == pytest.approx(
        (np.cos(np.pi / 6), np.sin(np.pi / 6))
    )
    both = lbt.load_config(LBT_YAML).plant.vibrations
    assert [v.direction for v in both] == [(1.0, 0.0), (0.0, 1.0)]


def test_sensor_gain_of_model_and_truth_are_relative(tmp_path):
    content = change_key(("truth", "sensor_gain"), 0.5)
    content["model"]["sensor_gain"] = 0.5
    config = lbt.load_config(write_config(tmp_path, content))
    assert config.truth.sensor_gain == 1.0  # relative to what the design assumes
    assert np.array_equal(config.hardware.sensor, 0.5 * np.eye(2))


def test_a_plant_without_vibrations(tmp_path):
    config = lbt.load_config(write_config(tmp_path, change_key(("model", "vibrations"), ...)))
    assert config.plant.vibrations == ()


def test_no_telescope_and_no_atmosphere(tmp_path):
    config = lbt.load_config(write_config(tmp_path, SMALL))
    assert config.atmosphere is None
    assert config.truth.turbulence is config.plant.turbulence[0]  # the model, without an atmosphere
    assert config.imaging.diameter_m is None
    assert config.settings.true_turbulence == "model"
    assert lbt.load_config(LBT_YAML).settings.true_turbulence == "frozen_flow"


def test_axes_that_differ(tmp_path):
    content = minimal_config(
        sensor={"noise_nm": [15.5, 6.0]},
        model={"turbulence": [AR, OTHER], "sensor_gain": [0.9, 0.7]},
        truth={"vibrations": "model", "sensor_gain": [0.45, 0.35]},
    )
    config = lbt.load_config(write_config(tmp_path, content))
    assert [m.order for m in config.plant.turbulence] == [1, 2]
    assert config.truth.turbulence == config.plant.turbulence
    assert config.truth.vibrations == config.plant.vibrations
    assert config.truth.noise_per_measurement(2).tolist() == config.noise_nm.tolist() == [15.5, 6.0]
    assert config.truth.sensor_gain == pytest.approx(0.5)
    assert config.sensor_gain == pytest.approx(0.8)
    np.testing.assert_array_equal(config.hardware.sensor, np.diag([0.9, 0.7]))
    # a single real gain is the mean over the axes, which keep their proportion
    content["truth"]["sensor_gain"] = 0.4
    assert lbt.load_config(write_config(tmp_path, content)).truth.sensor_gain == pytest.approx(0.5)


def test_ar2_is_fitted_above_the_noise_of_its_axis(tmp_path, air):
    content = change_key(("sensor",), {"noise_nm": [15.5, 60.0]})
    content["model"]["turbulence"] = {"kind": "ar2"}
    models = lbt.load_config(write_config(tmp_path, content)).plant.turbulence
    for model, noise in zip(models, (15.5, 60.0), strict=True):
        alone = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=noise)
        np.testing.assert_array_equal(model.coefficients, alone.coefficients)
    content["model"]["turbulence"] = [{"kind": "ar1"}, AR]
    first, second = lbt.load_config(write_config(tmp_path, content)).plant.turbulence
    assert first.coefficients[0] == pytest.approx(0.98860, abs=5e-6)
    assert second.coefficients.tolist() == [0.99]


@pytest.mark.parametrize("direction", [{}, {"axis": "tip"}])
def test_one_axis(tmp_path, direction):
    line = {"frequency_hz": 20.0, "damping": 0.01, "rms_nm": 300.0, **direction}
    content = minimal_config(loop={"axes": 1}, model={"vibrations": [line]})
    config = lbt.load_config(write_config(tmp_path, content))
    assert config.hardware.modes == 1
    assert config.plant.vibrations[0].direction == (1.0,)
    both = lbt.load_config(write_config(tmp_path, minimal_config(loop={"axes": 2})))
    # tip of the two
    truth = lbt.Truth(
        turbulence=both.plant.turbulence, vibrations=both.plant.vibrations, noise_nm=15.5
    )
    limit = lbt.loop.least_residual(both.hardware, truth, frame_means=True)
    assert lbt.kalman(config.plant).rms ** 2 == pytest.approx(limit.variance_nm2[0], rel=1e-6)


def test_a_configuration_may_have_one(tmp_path):
    (found,) = lbt.load_config(drift_file(tmp_path)).truth.vibrations
    expected = DriftingVibration(start_hz=17, end_hz=23, duration_s=60, rms_nm=797)
    assert found == expected
    damped = "kind: drift\n      end_hz: 16\n      duration_s: 9\n      damping: 0.01"
    (found,) = lbt.load_config(drift_file(tmp_path, damped)).truth.vibrations
    assert (found.damping, found.end_hz, found.duration_s) == (0.01, 16, 9)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("kind: drift", "end_hz is missing, which goes with kind: drift"),
        ("kind: drift\n      end_hz: 23", "duration_s is missing, which goes with kind: drift"),
        ("kind: sinusoid\n      end_hz: 23", "end_hz goes with kind: drift, and only"),
        ("kind: sinusoid\n      damping: 0.1", "damping goes with kind: resonance"),
        ("kind: drift\n      end_hz: 500\n      duration_s: 60", r"\[0\].end_hz: must lie below"),
        ("kind: drift\n      end_hz: -3\n      duration_s: 60", "greater than or equal to 0.001"),
        (
            "kind: drift\n      end_hz: 2\n      duration_s: 60\n      damping: 0.5",
            r"truth.vibrations\[0\]: .* frequency above that",
        ),
    ],
)
def test_wrong_keys_are_refused(tmp_path, keys, words):
    with pytest.raises(ConfigError, match=words):
        lbt.load_config(drift_file(tmp_path, keys))


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
        ({"spread_hz": -1.0}, "greater than or equal to 0.001"),
        ({"spread_hz": 1.0, "lines": 65}, "less than or equal to 64"),
        ({"frequency_hz": 399.0, "spread_hz": 9.0}, r"vibrations\[0\].spread_hz: .*Nyquist"),
    ):
        with pytest.raises(ConfigError, match=text):
            lbt.load_config(write_vibration(tmp_path, **keys))


# Configuration and command line
def test_the_example_has_a_mirror_for_design_and_loop():
    config = lbt.load_config(SLOW_YAML)
    assert config.hardware.mirror is config.plant.hardware.mirror
    step = config.hardware.mirror.step_response()
    assert 3e-3 < step.settling_s < 6e-3
    rows = mirror_rows(config.plant, config.truth, config.imaging)
    by_name = {row.design: row for row in rows}
    assert not by_name["kalman, settled mirror"].stable
    assert by_name["lqg"].strehl > 0.8
    assert by_name["lqg"].residual_nm < 0.3 * by_name["kalman, real positions"].residual_nm


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bandwidth_hz: 100.0", "bandwith_hz: 100.0", "did you mean bandwidth_hz"),
        (
            "bandwidth_hz: 100.0",
            "proportional_per_s2: 4.0e5",
            "exactly one of bandwidth_hz, derivative_per_s",
        ),
        (
            "    bandwidth_hz: 100.0",
            "    proportional_per_s2: 4.0e5\n    derivative_per_s: 800.0",
            "bandwidth_damping goes with bandwidth_hz",
        ),
        ("bandwidth_hz: 100.0", "bandwidth_hz: 10.0", "mirror.local_loop: bandwidth_hz must be"),
        ("frame_rate_hz: 800.0", "frame_rate_hz: 990.0", "986.30137 and 1000 Hz"),
        ("delay_samples: 1", "delay_samples: 1.5", "mirror.local_loop.delay_samples"),
    ],
)
def test_wrong_sections_are_refused(tmp_path, old, new, message):
    text = SLOW_YAML.read_text()
    assert old in text
    path = tmp_path / "a.yaml"
    path.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        lbt.load_config(path)


def test_gains_of_a_configuration(tmp_path):
    text = SLOW_YAML.read_text()
    start = text.index("    bandwidth_hz: 100.0")
    end = text.index("    sampling_hz")
    path = tmp_path / "a.yaml"
    path.write_text(
        text[:start] + "    proportional_per_s2: 4.0e5\n    derivative_per_s: 800.0\n" + text[end:]
    )
    mirror = lbt.load_config(path).hardware.mirror
    assert (mirror.proportional_per_s2, mirror.derivative_per_s) == (4.0e5, 800.0)


@pytest.mark.parametrize(
    ("stated", "errors", "widest"),
    [
        (({}, {}), None, 3.5),
        (({"frequency_error_hz": 0}, {"frequency_error_percent": 5}), (0, 0, 2), 2.0),
        (({}, {"frequency_error_hz": 1.0}), (0, 0, 1), 1.0),
        (({"frequency_error_hz": 0}, {"frequency_error_hz": 0}), (0, 0, 0), 0.0),
    ],
)
def test_frequency_errors_of_each_line(tmp_path, stated, errors, widest):
    lines = [line | more for line, more in zip(LINES, stated, strict=True)]
    config = lbt.load_config(write_config(tmp_path, minimal_config(truth={"vibrations": lines})))
    assert config.truth.frequency_errors_hz == errors  # the first line is one on each axis
    assert max(config.errors_hz) == pytest.approx(widest)
    assert min(config.errors_hz) == pytest.approx(-widest)


def test_a_slow_line_alone_has_small_errors(tmp_path):
    config = lbt.load_config(
        write_config(tmp_path, minimal_config(truth={"vibrations": LINES[:1]}))
    )
    assert config.truth.frequency_errors_hz is None
    assert max(config.errors_hz) == pytest.approx(0.175 * 0.3)
    bare = lbt.load_config(write_config(tmp_path, minimal_config()))
    assert bare.errors_hz == [0.0]


def test_a_line_has_one_frequency_error(tmp_path):
    line = LINES[0] | {"frequency_error_hz": 1, "frequency_error_percent": 5}
    with pytest.raises(ConfigError, match="one of frequency_error_hz, frequency_error"):
        lbt.load_config(write_config(tmp_path, minimal_config(truth={"vibrations": [line]})))


def load_sensors(tmp_path, *edits):
    """The configuration with parts of its text replaced."""
    text = SENSORS
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    return lbt.load_config(write_sensors(tmp_path, text))


def test_a_file_describes_its_sensors(sensors_config):
    plant = sensors_config.plant
    assert plant.hardware.suite.units == ("wavefront", "slow", "m1", "m2")
    assert plant.period == 2
    assert plant.read.tolist() == [[True] * 6, [True, True, False, False, True, True]]
    assert plant.motions[1]["m2"].phase_deg == 150
    assert sensors_config.truth.motions == plant.motions


def test_lines_of_the_truth_name_their_channels(tmp_path):
    line = "{axis: tip, kind: sinusoid, frequency_hz: 21, rms_nm: 400, accelerometers: {m1: {motion_nm_per_nm: 3}}}"
    config = load_sensors(
        tmp_path, ("truth: {vibrations: model}", f"truth: {{vibrations: [{line}]}}")
    )
    assert config.truth.motions[0]["m1"].size == 3


def test_a_spread_line_moves_its_channels_with_each_of_its_lines(tmp_path):
    config = load_sensors(
        tmp_path,
        (
            "frequency_hz: 20, damping: 0.01",
            "frequency_hz: 20, spread_hz: 1, lines: 3, damping: 0.01",
        ),
    )
    motions = config.plant.motions
    assert [sorted(motion) for motion in motions] == [["m1"], ["m1"], ["m1"], ["m2"]]


def test_correlated_noise(tmp_path):
    config = load_sensors(
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
        (", noise_nm: 20}", "}", "exactly one of noise_nm, noise_m_s2, covariance"),
        ("channels: [m1, m2], ", "", "channels is missing"),
        ("{rate_hz: 500, delay", "{rate: 500, delay", "unknown key sensors.slow.rate"),
        ("  slow: {rate_hz: 500,", "  wavefront: {rate_hz: 500,", "none of them 'wavefront'"),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, said):
    with pytest.raises(ConfigError, match=said):
        load_sensors(tmp_path, (old, new))


def test_a_horizon_makes_all_sensors_later(sensors_config):
    hardware = sensors_config.design("kalman", horizon=2).hardware
    assert hardware.delay_frames == 3
    assert [sensor.delay_frames for sensor in hardware.suite.sensors] == [3.0, 2.0]


def test_methods_for_the_own_sensor_leave_the_others_out(sensors_config):
    design = sensors_config.design("integrator", gain=0.3)
    assert design.controller.D.shape == (2, 2)
    assert design.assumptions == ("the loop's own sensor is read alone, without slow, m1, m2",)


def test_a_sensor_matrix_cannot_be_simulated(tmp_path):
    text = (
        Path(END_TO_END)
        .read_text()
        .replace("sensor:\n", "sensor:\n  matrix: [[1, 0], [0, 2]]\n", 1)
    )
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"sensor\.matrix must be left out"):
        _ = lbt.load_config(tmp_path / "c.yaml").end_to_end


def test_without_a_pyramid(tmp_path):
    text = Path(END_TO_END).read_text()
    start, end = text.index("  pyramid:"), text.index("mirror:")
    (tmp_path / "c.yaml").write_text(text[:start] + "  noise_nm: 15.0\n\n" + text[end:])
    with pytest.raises(ConfigError, match=r"sensor\.pyramid is missing"):
        _ = lbt.load_config(tmp_path / "c.yaml").end_to_end
