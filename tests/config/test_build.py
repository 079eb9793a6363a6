"""Plant, truth, sensors and end-to-end simulation that a configuration describes."""

from pathlib import Path

import numpy as np
import pytest
from support.configs import (
    AR,
    OTHER,
    SMALL,
    change_key,
    minimal_config,
    write_config,
    write_vibration,
)
from support.drifting import drift_file
from support.end_to_end import CONFIG as END_TO_END
from support.plants import LBT_YAML, ROOT
from support.refusals import refused
from support.several_sensors import CONFIG as SENSORS
from support.several_sensors import write_config as write_sensors

import lbt_synth as lbt
from lbt_synth.errors import ConfigError
from lbt_synth.models import SinusoidalVibration

SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"
LINES = [
    {"kind": "sinusoid", "frequency_hz": 0.3, "rms_nm": 400, "axis": "both"},
    {"kind": "sinusoid", "frequency_hz": 40.0, "rms_nm": 50, "axis": "tip"},
]


def load(tmp_path, content):
    return lbt.load_config(write_config(tmp_path, content))


def load_minimal(tmp_path, **sections):
    return load(tmp_path, minimal_config(**sections))


def edited(source, tmp_path, *edits):
    """Return the path of a text with parts of it replaced."""
    for old, new in edits:
        assert old in source
        source = source.replace(old, new)
    (tmp_path / "a.yaml").write_text(source)
    return tmp_path / "a.yaml"


def test_every_kind_of_turbulence_noise_and_direction(tmp_path):
    def changed(path, value):
        return load(tmp_path, change_key(path, value))

    ar2 = changed(("model", "turbulence"), {"kind": "ar2"}).plant.turbulence[0]
    assert ar2.coefficients == pytest.approx([1.99747, -0.99755], abs=1e-4)
    given = {"kind": "ar", "coefficients": [0.9, 0.05], "driving_rms_nm": 3.0}
    ar = changed(("model", "turbulence"), given).plant.turbulence[0]
    assert ar.coefficients.tolist() == [0.9, 0.05]
    noise_nm = changed(("sensor",), {"noise_mas": 2.0}).noise_nm
    assert noise_nm == pytest.approx(2 * lbt.models.nm_per_mas(8.22))
    line = {"direction_deg": 30.0, "frequency_hz": 20.0, "damping": 0.01, "rms_nm": 5.0}
    (made,) = changed(("model", "vibrations"), [line]).plant.vibrations
    assert made.direction == pytest.approx((np.cos(np.pi / 6), np.sin(np.pi / 6)))
    both = lbt.load_config(LBT_YAML).plant.vibrations
    assert [v.direction for v in both] == [(1.0, 0.0), (0.0, 1.0)]
    assert changed(("model", "vibrations"), ...).plant.vibrations == ()


def test_sensor_gain_of_model_and_truth_are_relative(tmp_path):
    content = change_key(("truth", "sensor_gain"), 0.5)
    content["model"]["sensor_gain"] = 0.5
    config = load(tmp_path, content)
    assert config.truth.sensor_gain == 1.0  # relative to what the design assumes
    assert np.array_equal(config.hardware.sensor, 0.5 * np.eye(2))


def test_no_telescope_and_no_atmosphere(tmp_path):
    config = load(tmp_path, SMALL)
    assert config.atmosphere is None
    assert config.truth.turbulence is config.plant.turbulence[0]  # the model, without an atmosphere
    assert config.imaging.diameter_m is None
    assert config.settings.true_turbulence == "model"
    assert lbt.load_config(LBT_YAML).settings.true_turbulence == "frozen_flow"


def test_axes_that_differ(tmp_path):
    content = minimal_config(
        sensor={"noise_nm": [15.5, 6.0]},
        model={"turbulence": [AR, OTHER], "sensor_gain": [0.9, 0.7]},
        truth={"vibrations": "model", "sensor_gain": 0.4},
    )
    config = load(tmp_path, content)
    assert [m.order for m in config.plant.turbulence] == [1, 2]
    assert config.truth.turbulence == config.plant.turbulence
    assert config.truth.vibrations == config.plant.vibrations
    assert config.truth.noise_per_measurement(2).tolist() == config.noise_nm.tolist() == [15.5, 6.0]
    # a real gain is the mean over the axes, which keep their proportion
    assert config.truth.sensor_gain == pytest.approx(0.5)
    assert config.sensor_gain == pytest.approx(0.8)
    np.testing.assert_array_equal(config.hardware.sensor, np.diag([0.9, 0.7]))


def test_ar2_is_fitted_above_the_noise_of_its_axis(tmp_path, air):
    content = change_key(("sensor",), {"noise_nm": [15.5, 60.0]})
    content["model"]["turbulence"] = {"kind": "ar2"}
    models = load(tmp_path, content).plant.turbulence
    for model, noise in zip(models, (15.5, 60.0), strict=True):
        alone = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=noise)
        np.testing.assert_array_equal(model.coefficients, alone.coefficients)
    content["model"]["turbulence"] = [{"kind": "ar1"}, AR]
    first, second = load(tmp_path, content).plant.turbulence
    assert first.coefficients[0] == pytest.approx(0.98860, abs=5e-6)
    assert second.coefficients.tolist() == [0.99]


@pytest.mark.parametrize("direction", [{}, {"axis": "tip"}])
def test_one_axis(tmp_path, direction):
    line = {"frequency_hz": 20.0, "damping": 0.01, "rms_nm": 300.0, **direction}
    config = load_minimal(tmp_path, loop={"axes": 1}, model={"vibrations": [line]})
    assert config.hardware.modes == 1
    assert config.plant.vibrations[0].direction == (1.0,)
    both = load_minimal(tmp_path, loop={"axes": 2}).plant  # of which it is tip
    truth = lbt.Truth(turbulence=both.turbulence, vibrations=both.vibrations, noise_nm=15.5)
    limit = lbt.loop.least_residual(both.hardware, truth, frame_means=True)
    assert lbt.kalman(config.plant).rms ** 2 == pytest.approx(limit.variance_nm2[0], rel=1e-6)


def test_a_line_may_drift(tmp_path):
    (drift,) = lbt.load_config(drift_file(tmp_path)).truth.vibrations
    assert drift == SinusoidalVibration(frequency_hz=17, end_hz=23, duration_s=60, rms_nm=797)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("kind: drift", "end_hz is missing, which goes with kind: drift"),
        ("kind: drift\n end_hz: 23", "duration_s is missing, which goes with kind: drift"),
        ("kind: sinusoid\n end_hz: 23", "end_hz goes with kind: drift, and only"),
        ("kind: sinusoid\n damping: 0.1", "damping goes with kind: resonance"),
        ("kind: drift\n end_hz: 500\n duration_s: 60", r"\[0\].end_hz: must lie below"),
    ],
)
def test_wrong_keys_of_a_line_are_refused(tmp_path, keys, words):
    with pytest.raises(ConfigError, match=words):
        lbt.load_config(drift_file(tmp_path, keys.replace("\n ", "\n      ")))


def test_priors_of_a_configuration(tmp_path):
    plain = lbt.load_config(LBT_YAML).plant
    for keys, lines in (({"spread_hz": 1.0}, 5), ({"spread_hz": 0.5, "lines": 2}, 2)):
        plant = lbt.load_config(write_vibration(tmp_path, **keys)).plant
        expected = lbt.models.spread_plant(plain, half_width_hz=keys["spread_hz"], lines=lines)
        np.testing.assert_allclose(plant.A, expected.A, rtol=1e-13)
        np.testing.assert_allclose(plant.B, expected.B, rtol=1e-11)
    for keys, text in (
        ({"lines": 3}, r"vibrations\[0\]: lines goes with spread_hz, and only with it"),
        ({"frequency_hz": 399.0, "spread_hz": 9.0}, r"vibrations\[0\].spread_hz: .*Nyquist"),
    ):
        with pytest.raises(ConfigError, match=text):
            lbt.load_config(write_vibration(tmp_path, **keys))


def test_the_example_has_a_mirror_for_design_and_loop(tmp_path):
    config = lbt.load_config(SLOW_YAML)
    assert config.hardware.mirror is config.plant.hardware.mirror
    step = config.hardware.mirror.step_response()
    assert 3e-3 < step.settling_s < 6e-3
    gains = "    proportional_per_s2: 4.0e5\n    derivative_per_s: 800.0\n"
    head, rest = SLOW_YAML.read_text().split("    bandwidth_hz: 100.0")
    (tmp_path / "a.yaml").write_text(head + gains + rest[rest.index("    sampling_hz") :])
    mirror = lbt.load_config(tmp_path / "a.yaml").hardware.mirror
    assert (mirror.proportional_per_s2, mirror.derivative_per_s) == (4.0e5, 800.0)


BANDWIDTH, GAIN = "    bandwidth_hz: 100.0", "    proportional_per_s2: 4.0e5"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (BANDWIDTH, "    bandwith_hz: 100.0", "did you mean bandwidth_hz"),
        (BANDWIDTH, GAIN, "exactly one of bandwidth_hz, derivative_per_s"),
        (BANDWIDTH, f"{GAIN}\n    derivative_per_s: 800.0", "damping goes with bandwidth_hz"),
        ("frame_rate_hz: 800.0", "frame_rate_hz: 990.0", "986.30137 and 1000 Hz"),
        ("delay_samples: 1", "delay_samples: 1.5", "mirror.local_loop.delay_samples"),
    ],
)
def test_wrong_sections_of_a_mirror_are_refused(tmp_path, old, new, words):
    path = edited(SLOW_YAML.read_text(), tmp_path, (old, new))
    refused(lambda: lbt.load_config(path), ConfigError, words)


@pytest.mark.parametrize(
    ("stated", "errors", "widest"),
    [
        (({}, {}), None, 3.5),
        (({"frequency_error_hz": 0}, {"frequency_error_hz": 2}), (0, 0, 2), 2.0),
        (({}, {"frequency_error_hz": 1.0}), (0, 0, 1), 1.0),
        (({"frequency_error_hz": 0}, {"frequency_error_hz": 0}), (0, 0, 0), 0.0),
    ],
)
def test_frequency_errors_of_each_line(tmp_path, stated, errors, widest):
    lines = [line | more for line, more in zip(LINES, stated, strict=True)]
    config = load_minimal(tmp_path, truth={"vibrations": lines})
    assert config.truth.frequency_errors_hz == errors  # the first line is one on each axis
    assert max(config.errors_hz) == -min(config.errors_hz) == pytest.approx(widest)


def test_a_slow_line_alone_has_small_errors(tmp_path):
    config = load_minimal(tmp_path, truth={"vibrations": LINES[:1]})
    assert config.truth.frequency_errors_hz is None
    assert max(config.errors_hz) == pytest.approx(0.175 * 0.3)
    assert load_minimal(tmp_path).errors_hz == [0.0]


def load_sensors(tmp_path, old, new):
    """Load the configuration of several sensors with a part of its text replaced."""
    assert old in SENSORS
    return lbt.load_config(write_sensors(tmp_path, SENSORS.replace(old, new)))


def test_a_file_describes_its_sensors(sensors_config, tmp_path):
    plant = sensors_config.plant
    assert plant.hardware.suite.units == ("wavefront", "slow", "m1", "m2")
    assert plant.period == 2
    assert plant.read.tolist() == [[True] * 6, [True, True, False, False, True, True]]
    assert plant.motions[1]["m2"].phase_deg == 150
    assert sensors_config.truth.motions == plant.motions
    # lines of the truth name their channels
    line = "{axis: tip, kind: sinusoid, frequency_hz: 21, rms_nm: 400, accelerometers: {m1: {motion_nm_per_nm: 3}}}"
    config = load_sensors(
        tmp_path, "truth: {vibrations: model}", f"truth: {{vibrations: [{line}]}}"
    )
    assert config.truth.motions[0]["m1"].size == 3
    # a spread line moves its channels with each of its lines
    spread = "frequency_hz: 20, spread_hz: 1, lines: 3, damping: 0.01"
    config = load_sensors(tmp_path, "frequency_hz: 20, damping: 0.01", spread)
    motions = [sorted(motion) for motion in config.plant.motions]
    assert motions == [["m1"], ["m1"], ["m1"], ["m2"]]
    covariance = "covariance: [[4.0e-8, 2.0e-8], [2.0e-8, 4.0e-8]]"
    config = load_sensors(tmp_path, "noise_m_s2: 2.0e-4", covariance)
    factor = config.plant.hardware.suite.accelerometers[0].noise_factor(2)
    assert np.allclose(factor @ factor.T, [[4e-8, 2e-8], [2e-8, 4e-8]])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("channels: [m1, m2]", "channels: [m1, wavefront]", "different names"),
        ("channels: [m1, m2]", "channels: [m1]", "names the channel 'm2'"),
        ("noise_m_s2: 2.0e-4", "noise_nm: 2", "goes with kind: wavefront"),
        (", noise_nm: 20}", "}", "exactly one of noise_nm, noise_m_s2, covariance"),
        ("channels: [m1, m2], ", "", "channels is missing"),
        ("{rate_hz: 500, delay", "{rate: 500, delay", "unknown key sensors.slow.rate"),
    ],
)
def test_mistakes_of_sensors_are_named(tmp_path, old, new, said):
    with pytest.raises(ConfigError, match=said):
        load_sensors(tmp_path, old, new)


def test_methods_for_the_own_sensor_leave_the_others_out(sensors_config):
    design = sensors_config.design("integrator", gain=0.3)
    assert design.controller.D.shape == (2, 2)
    assert design.assumptions == ("the loop's own sensor is read alone, without slow, m1, m2",)


def test_an_end_to_end_simulation_needs_a_pyramid_alone(tmp_path):
    text = Path(END_TO_END).read_text()
    pyramid = text[text.index("  pyramid:") : text.index("mirror:")]
    for old, new, words in (
        ("sensor:\n", "sensor:\n  matrix: [[1, 0], [0, 2]]\n", r"matrix must be left out"),
        (pyramid, "  noise_nm: 15.0\n\n", r"pyramid is missing"),
    ):
        config = lbt.load_config(edited(text, tmp_path, (old, new)))
        refused(lambda c=config: c.end_to_end, ConfigError, rf"sensor\.{words}")
