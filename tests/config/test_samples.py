"""Samples of a configuration as an ensemble of loops: which numbers may differ."""

import numpy as np
import pytest
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.config.samples import array_keys, build_ensemble, parse_path, with_arrays
from lbt_synth.errors import ProblemError

COUNT = 4


def ensemble_of(values, **errors):
    numbers = {"delay_error_frames": np.zeros(COUNT), "noise_factor": np.ones(COUNT)} | errors
    return build_ensemble(lbt.load_config(LBT_YAML), values, **numbers)


def test_arrays_leave_the_settings_as_they_are():
    keys, values = parse_path("model.vibrations[0].rms_mas"), np.array([1.0, 2.0, 3.0, 4.0])
    settings = lbt.load_config(LBT_YAML).settings
    changed = with_arrays(settings, {keys: values})
    assert changed.model.vibrations[0].rms_mas is values
    assert settings.model.vibrations[0].rms_mas == 80
    assert changed.truth is settings.truth


def test_which_numbers_are_taken_as_arrays(tmp_path):
    keys = array_keys(lbt.load_config(LBT_YAML).settings)
    for path in (
        "truth.sensor_gain",
        "atmosphere.seeing_arcsec",
        "truth.vibrations[0].rms_mas",
        "sensor.pyramid.photons",
        "model.vibrations[0].rms_mas",
        "model.sensor_gain",
        "loop.delay_frames",
    ):
        assert parse_path(path) in keys
    for path in (
        "telescope.diameter_m",
        "loop.frame_rate_hz",
        "imaging.wavelength_um",
        "atmosphere.seeing_wavelength_um",
        "design.gamma_ratio",  # which no builder reads
    ):
        assert parse_path(path) not in keys
    # what the real turbulence is computed from, where it is the model's
    for kind, noise in (("ar1", True), ("ar2", False)):
        text = LBT_YAML.read_text().replace("kind: ar1", f"kind: {kind}")
        (tmp_path / "c.yaml").write_text(
            text.replace("turbulence: frozen_flow", "turbulence: model")
        )
        keys = array_keys(lbt.load_config(tmp_path / "c.yaml").settings)
        assert parse_path("atmosphere.seeing_arcsec") not in keys
        assert (parse_path("sensor.pyramid.photons") in keys) == noise


def test_what_designs_assume_does_not_change_the_loops():
    expected = ensemble_of({})
    for path in ("model.vibrations[0].rms_mas", "model.sensor_gain"):
        ensemble = ensemble_of({parse_path(path): np.linspace(1.0, 2.0, COUNT)})
        assert ensemble.sensor_gain == expected.sensor_gain
        assert [line.rms_nm for line in ensemble.vibrations] == [
            line.rms_nm for line in expected.vibrations
        ]


@pytest.mark.parametrize(
    "errors",
    [
        {"delay_error_frames": np.array([0.0, -1.5, 0.0, 0.5])},
        {"delay_error_frames": np.array([0.0, 99.0, 0.0, 0.5])},
        {"noise_factor": np.array([1.0, -0.1, 1.0, 2.0])},
        {"noise_factor": np.array([1.0, np.nan, 1.0, 2.0])},
    ],
)
def test_real_delays_and_noises_that_no_loop_has(errors):
    with pytest.raises(ProblemError):
        ensemble_of({}, **errors)
