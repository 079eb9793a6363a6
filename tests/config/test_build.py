"""Plant, truth, sensors and end-to-end simulation that a configuration describes."""

import numpy as np
import pytest
from support.configs import AR, OTHER, SMALL, change_key, minimal_config, write_config
from support.drifting import drift_file
from support.plants import LBT_YAML, ROOT
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.errors import ConfigError
from lbt_synth.models import SinusoidalVibration

LBT = LBT_YAML.read_text()
SLOW = (ROOT / "examples" / "lbt_slow_mirror.yaml").read_text()


def load(tmp_path, content):
    return lbt.load_config(write_config(tmp_path, content))


def load_minimal(tmp_path, **sections):
    return load(tmp_path, minimal_config(**sections))


def edited(source, old, new):
    assert old in source
    return source.replace(old, new)


def test_every_kind_of_turbulence_noise_line_and_truth(tmp_path, config):
    given = {"kind": "ar", "coefficients": [0.9, 0.05], "driving_rms_nm": 3.0}
    line = {"direction_deg": 30.0, "frequency_hz": 20.0, "damping": 0.01, "rms_nm": 5.0}
    ar, mas, turned, shaken = (
        load(tmp_path, change_key(path.split("."), value))
        for path, value in {
            "model.turbulence": given,
            "sensor": {"noise_mas": 2.0},
            "model.vibrations": [line],
            "truth.vibrations": [line | {"kind": "resonance"}],
        }.items()
    )
    assert ar.plant.turbulence[0].coefficients.tolist() == [0.9, 0.05]
    assert mas.noise_nm == pytest.approx(2 * lbt.models.nm_per_mas(8.22))
    for (made,) in (turned.plant.vibrations, shaken.truth.vibrations):
        assert made.direction == pytest.approx((np.cos(np.pi / 6), np.sin(np.pi / 6)))
        assert (made.frequency_hz, made.damping, made.rms_nm) == (20.0, 0.01, 5.0)
    assert [v.direction for v in config.plant.vibrations] == [(1.0, 0.0), (0.0, 1.0)]
    calm = load(tmp_path, change_key(("model", "vibrations"), ...))
    assert calm.plant.vibrations == ()
    (drift,) = lbt.load_config(drift_file(tmp_path)).truth.vibrations
    assert drift == SinusoidalVibration(frequency_hz=17, end_hz=23, duration_s=60, rms_nm=797)
    small = load(tmp_path, SMALL)  # no telescope and no atmosphere
    assert (small.atmosphere, small.imaging.diameter_m) == (None, None)
    assert small.truth.turbulence is small.plant.turbulence[0]
    kinds = [each.settings.true_turbulence for each in (small, config)]
    assert kinds == ["model", "frozen_flow"]


def test_axes_that_differ(tmp_path):
    config = load_minimal(
        tmp_path,
        sensor={"noise_nm": [15.5, 6.0]},
        model={"turbulence": [AR, OTHER], "sensor_gain": [0.9, 0.7]},
        truth={"vibrations": "model", "sensor_gain": 0.4},
    )
    plant, truth = config.plant, config.truth
    assert [m.order for m in plant.turbulence] == [1, 2]
    assert (truth.turbulence, truth.vibrations) == (plant.turbulence, plant.vibrations)
    assert truth.noise_per_measurement(2).tolist() == config.noise_nm.tolist() == [15.5, 6.0]
    # a real gain is the mean over the axes, which keep their proportion
    assert (truth.sensor_gain, config.sensor_gain) == pytest.approx((0.5, 0.8))
    np.testing.assert_array_equal(config.hardware.sensor, np.diag([0.9, 0.7]))


def test_ar2_is_fitted_above_the_noise_of_its_axis(tmp_path, air):
    content = change_key(("sensor",), {"noise_nm": [15.5, 60.0]})
    content["model"]["turbulence"] = {"kind": "ar2"}
    models = load(tmp_path, content).plant.turbulence
    for model, noise in zip(models, (15.5, 60.0), strict=True):
        alone = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=noise)
        np.testing.assert_array_equal(model.coefficients, alone.coefficients)
    content["model"]["turbulence"] = [{"kind": "ar1"}, AR]
    first, second = (model.coefficients for model in load(tmp_path, content).plant.turbulence)
    assert (first[0], *second) == (pytest.approx(0.98860, abs=5e-6), 0.99)


def test_one_axis(tmp_path):
    both = lbt.kalman(load_minimal(tmp_path, loop={"axes": 2}).plant)  # of which it is tip
    for direction in ({}, {"axis": "tip"}):
        line = {"frequency_hz": 20.0, "damping": 0.01, "rms_nm": 300.0, **direction}
        config = load_minimal(tmp_path, loop={"axes": 1}, model={"vibrations": [line]})
        assert (config.hardware.modes, config.plant.vibrations[0].direction) == (1, (1.0,))
        assert lbt.kalman(config.plant).rms == pytest.approx(both.certificate.rms_per_output[0])


def test_priors_of_a_configuration(tmp_path, config):
    for keys, hz, lines in (("spread_hz: 1.0", 1.0, 5), ("spread_hz: 0.5, lines: 2", 0.5, 2)):
        plant = load(tmp_path, edited(LBT, "{axis: both", f"{{{keys}, axis: both")).plant
        expected = lbt.models.spread_plant(config.plant, half_width_hz=hz, lines=lines)
        np.testing.assert_allclose(plant.A, expected.A, rtol=1e-13)
        np.testing.assert_allclose(plant.B, expected.B, rtol=1e-11)


def test_the_example_has_a_mirror_for_design_and_loop(tmp_path):
    hardware = load(tmp_path, SLOW).hardware
    assert 3e-3 < hardware.mirror.step_response().settling_s < 6e-3
    gains = edited(SLOW, "bandwidth_hz: 100.0", "proportional_per_s2: 4.0e5")
    gains = edited(gains, "bandwidth_damping: 0.7", "derivative_per_s: 800.0")
    config = load(tmp_path, gains)
    mirror = config.hardware.mirror
    assert mirror is config.plant.hardware.mirror
    assert (mirror.proportional_per_s2, mirror.derivative_per_s) == (4.0e5, 800.0)


FAST = {"kind": "sinusoid", "frequency_hz": 40.0, "rms_nm": 50, "axis": "tip"}
KNOWN = {"frequency_error_hz": 0}
BOTH = {"kind": "sinusoid", "frequency_hz": 0.3, "rms_nm": 400, "axis": "both"}  # one on each axis


@pytest.mark.parametrize(
    ("lines", "errors", "widest"),
    [
        ([BOTH, FAST], None, 3.5),
        ([BOTH | KNOWN, FAST | {"frequency_error_hz": 2}], (0, 0, 2), 2.0),
        ([BOTH, FAST | {"frequency_error_hz": 1.0}], (0, 0, 1), 1.0),
        ([BOTH | KNOWN, FAST | KNOWN], (0, 0, 0), 0.0),
        ([BOTH], None, 0.175 * 0.3),  # a slow line alone has small errors
        ([], None, 0.0),
    ],
)
def test_frequency_errors_of_each_line(tmp_path, lines, errors, widest):
    config = load_minimal(tmp_path, truth={"vibrations": lines})
    assert config.truth.frequency_errors_hz == errors
    assert (max(config.errors_hz), -min(config.errors_hz)) == pytest.approx((widest, widest))


def test_a_file_describes_its_sensors(sensors_config, tmp_path):
    plant, text = sensors_config.plant, sensors_config.source.read_text()
    assert plant.hardware.suite.units == ("wavefront", "slow", "m1", "m2")
    assert plant.period == 2
    assert plant.read.tolist() == [[True] * 6, [True, True, False, False, True, True]]
    assert plant.motions[1]["m2"].phase_deg == 150
    assert sensors_config.truth.motions == plant.motions
    own = sensors_config.design("integrator", gain=0.3)  # which leaves the others out
    assert own.controller.D.shape == (2, 2)
    assert own.assumptions == ("the loop's own sensor is read alone, without slow, m1, m2",)
    line = "axis: tip, kind: sinusoid, frequency_hz: 21, rms_nm: 400"
    moved = f"truth: {{vibrations: [{{{line}, accelerometers: {{m1: {{motion_nm_per_nm: 3}}}}}}]}}"
    spread = "frequency_hz: 20, spread_hz: 1, lines: 3, damping: 0.01"
    covariance = "covariance: [[4.0e-8, 2.0e-8], [2.0e-8, 4.0e-8]]"
    named, many, noisy = (
        load(tmp_path, edited(text, old, new))
        for old, new in (
            ("truth: {vibrations: model}", moved),
            ("frequency_hz: 20, damping: 0.01", spread),
            ("noise_m_s2: 2.0e-4", covariance),
        )
    )
    assert named.truth.motions[0]["m1"].size == 3
    assert list(map(sorted, many.plant.motions)) == [["m1"], ["m1"], ["m1"], ["m2"]]
    factor = noisy.plant.hardware.suite.accelerometers[0].noise_factor(2)
    assert np.allclose(factor @ factor.T, [[4e-8, 2e-8], [2e-8, 4e-8]])


LINE, BANDWIDTH = "kind: sinusoid,", "    bandwidth_hz: 100.0"
GAIN = "    proportional_per_s2: 4.0e5"
PYRAMID = LBT[LBT.index("  pyramid:") : LBT.index("mirror:")]
CHANNELS, MATRIX = "channels: [m1, m2]", "  matrix: [[1, 0], [0, 2]]\n"


@pytest.mark.parametrize(
    ("source", "old", "new", "words"),
    [
        (LBT, LINE, "kind: drift,", "end_hz is missing, which goes with kind: drift"),
        (LBT, LINE, "kind: drift, end_hz: 23,", "duration_s is missing, which goes with kind: dr"),
        (LBT, LINE, f"{LINE} end_hz: 23,", "end_hz goes with kind: drift, and only"),
        (LBT, LINE, f"{LINE} damping: 0.1,", "damping goes with kind: resonance"),
        (LBT, LINE, "kind: drift, end_hz: 500, duration_s: 9,", r"\[0\].end_hz: must lie below"),
        (LBT, "axis: both", "axis: both, lines: 3", r"ns\[0\]: lines goes with spread_hz, and"),
        (LBT, "20.0, damping", "399.0, spread_hz: 9.0, damping", r"s\[0\].spread_hz: .*Nyquist"),
        (LBT, "sensor:\n", f"sensor:\n{MATRIX}", "sensor.matrix must be left out"),
        (LBT, PYRAMID, "  noise_nm: 15.0\n\n", "sensor.pyramid is missing"),
        (SLOW, BANDWIDTH, "    bandwith_hz: 100.0", "did you mean bandwidth_hz"),
        (SLOW, BANDWIDTH, GAIN, "exactly one of bandwidth_hz, derivative_per_s"),
        (SLOW, BANDWIDTH, f"{GAIN}\n    derivative_per_s: 800.0", "damping goes with bandwidth_hz"),
        (SLOW, "frame_rate_hz: 800.0", "frame_rate_hz: 990.0", "986.30137 and 1000 Hz"),
        (SLOW, "delay_samples: 1", "delay_samples: 1.5", "mirror.local_loop.delay_samples"),
        (None, CHANNELS, "channels: [m1, wavefront]", "different names"),
        (None, CHANNELS, "channels: [m1]", "names the channel 'm2'"),
        (None, "noise_m_s2: 2.0e-4", "noise_nm: 2", "goes with kind: wavefront"),
        (None, ", noise_nm: 20}", "}", "exactly one of noise_nm, noise_m_s2, covariance"),
        (None, f"{CHANNELS}, ", "", "channels is missing"),
        (None, "{rate_hz: 500, delay", "{rate: 500, delay", "unknown key sensors.slow.rate"),
    ],
)
def test_what_does_not_go_together_is_refused(tmp_path, sensors_config, source, old, new, words):
    """By the file (None is that of several sensors), or by its end-to-end simulation."""
    source = source or sensors_config.source.read_text()
    file = write_config(tmp_path, edited(source, old, new))
    refused(lambda: lbt.load_config(file).end_to_end, ConfigError, words)
