"""The plant and the truth that a configuration describes."""

from __future__ import annotations

import numpy as np
import pytest
from support.configs import AR, OTHER, SMALL, change_key, minimal_config, write_config
from support.plants import LBT_YAML

import lbt_synth as lbt


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
    limit = lbt.loop.least_residual(both.hardware, truth)
    assert lbt.kalman(config.plant).rms ** 2 == pytest.approx(limit.variance_nm2[0], rel=1e-6)
