"""Samples of a study, and their evaluation one by one."""

from dataclasses import replace

import numpy as np
import pytest
from support.plants import ROOT
from support.studies import LBT_TEXT, load_small_study

import lbt_synth as lbt
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.models import SinusoidalVibration
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


def test_a_point_is_what_the_library_says(tmp_path):
    study = load_small_study(
        tmp_path,
        samples="4",
        controllers="{fixed: {design: kalman}, own: {design: kalman, for: sample}, "
        "wild: {design: integrator, gain: 0.9}}",
        parameters="{'truth.vibrations[0].frequency_hz': {uniform: [18, 22], also: "
        "['model.vibrations[0].frequency_hz']}, error.delay_frames: {uniform: [0.2, 0.4]}, "
        "error.noise_factor: 1.5, truth.sensor_gain: 0.7}",
    )
    values = study.values()
    batch = lbt.studies.evaluate_samples(study, values[1:], 1)
    assert (batch.start, batch.failures) == (1, ())
    assert tuple(batch.columns) == study.result_columns
    config = study.config
    fixed = lbt.kalman(config.plant)
    for i, (frequency, delay, _, _) in enumerate(values[1:]):
        line = replace(config.plant.vibrations[0], frequency_hz=frequency)
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=800,
            turbulence=config.plant.turbulence[0],
            vibrations=[line],
            noise_nm=15.0,
            modes=1,
        )
        hardware = lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=2 + delay)
        truth = lbt.Truth(
            turbulence=config.plant.turbulence[0],
            vibrations=(SinusoidalVibration(frequency_hz=frequency, rms_nm=500, direction=(1.0,)),),
            noise_nm=22.5,
            sensor_gain=0.7,
        )
        for name, design in (("fixed", fixed), ("own", lbt.kalman(plant))):
            loop = lbt.close_loop(hardware, design.controller, sensor_gain=0.7)
            budget = lbt.residual_budget(loop, truth)
            for column in ("residual_nm", "turbulence_nm", "vibration_nm", "noise_nm"):
                expected = getattr(budget, column.replace("residual", "rms"))
                assert batch.columns[f"{name}.{column}"][i] == pytest.approx(expected, rel=1e-9)
            expected = lbt.strehl(budget, config.imaging)
            assert batch.columns[f"{name}.strehl"][i] == pytest.approx(expected, rel=1e-9)
            assert batch.columns[f"{name}.stable"][i] == 1
    assert np.all(batch.columns["own.residual_nm"] < 1.05 * batch.columns["fixed.residual_nm"])


def test_unstable_loops_and_samples_that_fail(tmp_path):
    study = load_small_study(
        tmp_path,
        samples="8",
        controllers="{wild: {design: integrator, gain: 0.9}, tight: {design: integrator, gain: "
        "0.7, for: sample}}",
        parameters="{truth.sensor_gain: {list: [0.3, 1.4]}, loop.delay_frames: {list: [2, 4]}}",
    )
    values = study.values()
    batch = lbt.studies.evaluate_samples(study, values, 0)
    unstable = values[:, 0] == 1.4
    stable, strehl = batch.columns["wild.stable"], batch.columns["wild.strehl"]
    assert np.all(stable[unstable] == 0)
    assert np.all(stable[~unstable] == 1)
    np.testing.assert_array_equal(np.isnan(strehl), unstable)
    slow = values[:, 1] == 4
    assert [failure.row for failure in batch.failures] == np.flatnonzero(slow).tolist()
    assert {failure.controller for failure in batch.failures} == {"tight"}
    assert "failed its certificate" in batch.failures[0].error
    np.testing.assert_array_equal(np.isnan(batch.columns["tight.stable"]), slow)
    lost = slow | (batch.columns["tight.stable"] == 0)
    np.testing.assert_array_equal(np.isnan(batch.columns["tight.strehl"]), lost)


def test_a_sample_that_is_no_configuration_fails_alone(tmp_path):
    study = load_small_study(tmp_path, controllers="{a: {design: kalman}, b: {design: integrator}}")
    values = study.values(0, 3)
    values[1] = -5.0
    batch = lbt.studies.evaluate_samples(study, values, 10)
    assert [(f.row, f.controller) for f in batch.failures] == [(11, "a"), (11, "b")]
    assert "greater than" in batch.failures[0].error
    assert np.isnan(batch.columns["a.stable"]).tolist() == [False, True, False]


def test_simulated_samples(tmp_path):
    study = load_small_study(
        tmp_path,
        evaluation="simulation",
        controllers="{a: {design: kalman}, b: "
        "{design: integrator, gain: 0.3}, c: {design: integrator, gain: 0.9}}",
        parameters="{truth.sensor_gain: {uniform: [1.2, 1.3]}}",
    )
    assert study.result_columns[:3] == ("a.strehl", "a.residual_nm", "a.stable")
    batch = lbt.studies.evaluate_samples(study, study.values(3, 5), 3)
    assert batch.columns["c.stable"].tolist() == [0, 0]
    for i, row in enumerate((3, 4)):
        sample = make_sample(study, study.values(row, row + 1)[0])
        loops = [
            lbt.close_loop(
                sample.hardware, c.design.controller, sensor_gain=sample.truth.sensor_gain
            )
            for c in study.controllers[:2]
        ]
        settle = max(100, *(settling_frames(x.spectral_radius) for x in loops))
        for loop, name in zip(loops, "ab", strict=True):
            run = lbt.simulate(
                loop.controller,
                sample.truth,
                hardware=sample.hardware,
                frames=400,
                cases=1,
                seed=study.simulation_seed(row),
                settle_frames=settle,
            )
            assert batch.columns[f"{name}.strehl"][i] == run.strehl(study.config.imaging).mean()
    assert study.simulation_seed(3) != study.simulation_seed(4)


def test_the_example():
    study = lbt.studies.load_study(ROOT / "examples" / "study.yaml")
    batch = lbt.studies.evaluate_samples(study, study.values(0, 1), 0)
    assert not batch.failures
    assert 0.2 < batch.columns["kalman.strehl"][0] < 0.845
