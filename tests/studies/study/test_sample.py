"""Samples as configurations."""

from __future__ import annotations

import numpy as np
import pytest
from support.studies import LBT_TEXT, load_small_study

import lbt_synth as lbt
from lbt_synth.studies.study.sample import make_sample


def test_a_sample_is_a_configuration(tmp_path):
    text = LBT_TEXT.replace("sensor_gain: 1.0", "sensor_gain: 0.8")
    study = load_small_study(
        tmp_path,
        base=text,
        parameters="{atmosphere.seeing_arcsec: {list: [0.5, 1.1]}, imaging.wavelength_um: 1.65, "
        "sensor.pyramid.subapertures_across: {list: [20, 30]}, 'robustness.errors_hz[0]': -4, "
        "'truth.vibrations[0].rms_mas': {uniform: [10, 20], also: ['model.vibrations[0].rms_mas']}, "
        "error.delay_frames: {uniform: [0, 0.5]}, error.noise_factor: {uniform: [1, 2]}}",
    )
    for values in study.values(0, 4):
        named = study.parameters_by_name(values)
        sample = make_sample(study, values)
        settings = sample.config.settings
        assert settings.atmosphere.seeing_arcsec == named["atmosphere.seeing_arcsec"]
        assert settings.imaging.wavelength_um == 1.65
        assert settings.robustness.errors_hz[:2] == [-4, -3]
        assert settings.sensor.pyramid.subapertures_across in (20, 30)
        rms = named["truth.vibrations[0].rms_mas"]
        assert settings.model.vibrations[0].rms_mas == settings.truth.vibrations[0].rms_mas == rms
        assumed = sample.config
        assert sample.truth.sensor_gain == 0.8
        assert assumed.hardware.delay_frames == 2.0
        assert sample.hardware.delay_frames == 2.0 + named["error.delay_frames"]
        assert sample.truth.noise_nm == pytest.approx(
            assumed.noise_nm * named["error.noise_factor"]
        )
        # the same from a file: the independent way
        content = text.replace(
            "seeing_arcsec: 0.8", f"seeing_arcsec: {settings.atmosphere.seeing_arcsec!r}"
        )
        content = content.replace("rms_mas: 80.0", f"rms_mas: {rms!r}")
        content = content.replace(
            "subapertures_across: 30",
            f"subapertures_across: {settings.sensor.pyramid.subapertures_across}",
        )
        (tmp_path / "same.yaml").write_text(content)
        same = lbt.load_config(tmp_path / "same.yaml")
        np.testing.assert_array_equal(same.plant.A, assumed.plant.A)
        np.testing.assert_array_equal(same.plant.B, assumed.plant.B)
        assert same.truth.noise_nm == assumed.truth.noise_nm
    assert study.config.settings.atmosphere.seeing_arcsec == 0.8  # the base is as it was
