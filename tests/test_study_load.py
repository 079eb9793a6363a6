"""Study files: what they say, what is refused, and the samples that they stand for."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.plants import ROOT
from support.studies import BASE, LBT_TEXT, loaded, study_file

import lbt_synth as lbt
from lbt_synth.errors import ConfigError, GainFileError, ProblemError
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.studies.study.distributions import Listed
from lbt_synth.studies.study.sample import make_sample

ONE = "truth.vibrations[0].rms_nm"


# ---------------------------------------------------------------- samples
@pytest.mark.parametrize("sampling", ["sobol", "latin_hypercube"])
def test_rows_do_not_depend_on_who_asks(tmp_path, sampling):
    study = loaded(
        tmp_path,
        sampling=sampling,
        samples="37",  # no power of two
        parameters=f"{{'{ONE}': {{uniform: [1, 2]}}, truth.sensor_gain: {{normal: "
        "{mean: 1, deviation: 0.1}}, loop.delay_frames: 2.5, sensor.noise_nm: {list: [1, 5]}}",
    )
    whole = study.values()
    assert whole.shape == (37, 4)
    pieces = [study.values(a, b) for a, b in [(0, 1), (1, 2), (2, 20), (20, 20), (20, 37)]]
    np.testing.assert_array_equal(np.vstack(pieces), whole)
    np.testing.assert_array_equal(lbt.studies.load_study(study.source).values(), whole)
    assert np.all(whole[:, 2] == 2.5)
    again = pickle.loads(pickle.dumps(study))
    np.testing.assert_array_equal(again.values(5, 9), whole[5:9])
    with pytest.raises(ProblemError, match="has 37 samples"):
        study.values(0, 38)


@pytest.mark.parametrize(
    ("sampling", "expected"),
    [
        (
            "sobol",
            [
                (0.6132053462788463, 1.133682976967863, 9.0),
                (1.425886674784124, 0.8811522781022142, 1.0),
                (1.042492190375924, 1.011796284607197, 9.0),
            ],
        ),
        (
            "latin_hypercube",
            [
                (1.0911643969210378, 1.0221509991610271, 9.0),
                (1.2114263432286294, 0.8760264961071796, 1.0),
                (0.9813972291557166, 1.1199074340906254, 5.0),
            ],
        ),
    ],
)
def test_rows_for_ever(tmp_path, sampling, expected):
    """Found once; a study that was begun must go on with the same rows, in later versions too."""
    study = loaded(
        tmp_path,
        sampling=sampling,
        parameters=f"{{'{ONE}': {{uniform: [0.5, 1.5]}}, truth.sensor_gain: {{normal: {{mean: 1, "
        "deviation: 0.1, low: 0.5, high: 1.2}}, sensor.noise_nm: {list: [1, 5, 9]}}",
    )
    np.testing.assert_allclose(study.values(0, 3), expected, rtol=1e-12)


def test_distributions(tmp_path):
    study = loaded(
        tmp_path,
        samples="4096",
        parameters=f"{{'{ONE}': {{uniform: [100, 300]}}, "
        "'model.vibrations[0].rms_nm': {normal: {mean: 400, deviation: 50}}, "
        "'truth.vibrations[0].frequency_hz': {normal: {mean: 20, deviation: 1, low: 19.5, high: 23}},"
        "sensor.noise_nm: {list: [10, 20, 30], weights: [1, 1, 2]}, "
        "truth.sensor_gain: {normal: {mean: 0.1, deviation: 0.01, low: 0.2}}}",
    )
    values = study.values()
    expected = [
        stats.uniform(100, 200),
        stats.norm(400, 50),
        stats.truncnorm(-0.5, 3, 20, 1),
        None,
        stats.truncnorm(10, np.inf, 0.1, 0.01),
    ]
    for column, law in zip(values.T, expected, strict=True):
        if law is not None:  # Sobol's points follow a law far more closely than random ones
            assert stats.kstest(column, law.cdf).statistic < 2 / 4096
    found, counts = np.unique(values[:, 3], return_counts=True)
    assert found.tolist() == [10, 20, 30]
    assert counts.tolist() == [1024, 1024, 2048]
    huge = Listed(values=(1.0, 2.0, 3.0), weights=(1e308, 1e308, 1e308))  # their sum is infinite
    assert huge.quantile(np.array([0.1, 0.5, 0.9])).tolist() == [1, 2, 3]


def test_more_samples_begin_with_the_same(tmp_path):
    few, many = (loaded(tmp_path, samples=n).values(0, 16) for n in ("16", "64"))
    np.testing.assert_array_equal(few, many)


def test_a_sample_is_a_configuration(tmp_path):
    text = LBT_TEXT.replace("sensor_gain: 1.0", "sensor_gain: 0.8")
    study = loaded(
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
        told = sample.config
        assert sample.truth.sensor_gain == 0.8
        assert told.hardware.delay_frames == 2.0
        assert sample.hardware.delay_frames == 2.0 + named["error.delay_frames"]
        assert sample.truth.noise_nm == pytest.approx(told.noise_nm * named["error.noise_factor"])
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
        np.testing.assert_array_equal(same.plant.A, told.plant.A)
        np.testing.assert_array_equal(same.plant.B, told.plant.B)
        assert same.truth.noise_nm == told.truth.noise_nm
    assert study.config.settings.atmosphere.seeing_arcsec == 0.8  # the base is as it was


def test_controllers(tmp_path):
    folder = tmp_path / "gains"
    folder.mkdir()
    made = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.4)
    lbt.save_gain(folder / "a.fits", made)
    study = loaded(
        tmp_path,
        controllers="{a: {file: gains/a.fits}, b: {design: kalman}, c: {design: hinf, gamma_ratio: "
        "1.5, for: sample}, d: {design: integrator}}",
    )
    a, b, c, d = study.controllers
    assert a.design.gain == 0.4
    assert b.design.certificate.passed
    assert (c.design, c.for_sample, c.request.options) == (None, True, {"gamma_ratio": 1.5})
    assert (
        d.design.gain
        == lbt.design.optimal_integrator(study.config.hardware, study.config.truth).gain
    )
    assert study.result_columns[:6] == (
        "a.strehl",
        "a.residual_nm",
        "a.turbulence_nm",
        "a.vibration_nm",
        "a.noise_nm",
        "a.stable",
    )
    assert study.columns[:2] == ("row", ONE)
    assert [path.name for path in study.inputs] == ["study.yaml", "base.yaml", "a.fits"]


def test_the_digest_is_of_what_decides_the_results(tmp_path):
    first = loaded(tmp_path).digest
    assert loaded(tmp_path, results="parquet").digest == first
    study_file(tmp_path).write_text("# a comment\n" + (tmp_path / "study.yaml").read_text())
    assert lbt.studies.load_study(tmp_path / "study.yaml").digest == first
    assert loaded(tmp_path, seed="4").digest != first
    assert loaded(tmp_path, base=BASE.replace("15.0", "15.1")).digest != first
    digests = set()
    for gain in (0.4, 0.5):
        made = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=gain)
        lbt.save_gain(tmp_path / "a.fits", made)
        digests.add(loaded(tmp_path, controllers="{a: {file: a.fits}}").digest)
    assert len(digests) == 2


# ---------------------------------------------------------------- refusals
@pytest.mark.parametrize(
    ("changes", "message", "path"),
    [
        ({"samplse": "5"}, "unknown key samplse; did you mean samples", "samplse"),
        ({"samples": None}, "the key samples is missing", "samples"),
        ({"samples": "0"}, "samples: input should be greater than or equal to 1; got 0", "samples"),
        ({"samples": "1.5"}, "samples: input should be a valid integer", "samples"),
        (
            {"sampling": "random"},
            "sampling: input should be 'sobol' or 'latin_hypercube'",
            "sampling",
        ),
        (
            {"evaluation": "fast"},
            "evaluation: input should be 'exact' or 'simulation'",
            "evaluation",
        ),
        ({"results": "xls"}, "results: input should be 'csv' or 'parquet'", "results"),
        ({"version": "2"}, "version: input should be less than or equal to 1", "version"),
        ({"controllers": "{}"}, "controllers", "controllers"),
        ({"parameters": "{}"}, "parameters", "parameters"),
        (
            {"parameters": f"{{'{ONE}': {{unifrom: [1, 2]}}}}"},
            r"unknown key parameters\.truth\.vibrations\[0\]\.rms_nm\.unifrom; did you mean uniform",
            f"parameters.{ONE}.unifrom",
        ),
        (
            {"parameters": f"{{'{ONE}': {{uniform: [2, 1]}}}}"},
            r"must be \[low, high\]; got \[2, 1\]",
            None,
        ),
        ({"parameters": f"{{'{ONE}': {{uniform: [1]}}}}"}, "uniform", None),
        ({"parameters": f"{{'{ONE}': {{uniform: [1, .inf]}}}}"}, "finite", None),
        ({"parameters": f"{{'{ONE}': {{}}}}"}, "expected a number or exactly one of", None),
        (
            {"parameters": f"{{'{ONE}': {{fixed: 1, list: [2]}}}}"},
            "expected a number or exactly one",
            None,
        ),
        ({"parameters": f"{{'{ONE}': fast}}"}, ONE.replace("[", r"\["), None),
        ({"parameters": f"{{'{ONE}': {{list: []}}}}"}, "list", None),
        ({"parameters": f"{{'{ONE}': {{list: [a]}}}}"}, "valid number; got 'a'", None),
        (
            {"parameters": f"{{'{ONE}': {{list: [1, 2], weights: [1]}}}}"},
            "weights goes with list",
            None,
        ),
        (
            {"parameters": f"{{'{ONE}': {{uniform: [1, 2], weights: [1]}}}}"},
            "weights goes with list",
            None,
        ),
        ({"parameters": f"{{'{ONE}': {{list: [1, 2], weights: [1, 0]}}}}"}, "greater than 0", None),
        (
            {"parameters": f"{{'{ONE}': {{normal: {{mean: 1, deviation: 0}}}}}}"},
            "deviation: input should be gr",
            None,
        ),
        (
            {"parameters": f"{{'{ONE}': {{normal: {{mean: 1, deviation: 1, low: 3, high: 2}}}}}}"},
            "low must be below high",
            None,
        ),
        (
            {
                "parameters": f"{{'{ONE}': {{normal: {{mean: 1, deviation: 0.01, low: 3, high: 4}}}}}}"
            },
            "has nothing between 3 and 4",
            None,
        ),
        (
            {"parameters": "{'truth.vibration[0].rms_nm': 5}"},
            "truth has no vibration; did you mean vibrations",
            None,
        ),
        (
            {"parameters": "{'truth.vibrations[1].rms_nm': 5}"},
            r"truth\.vibrations has 1 entry, counted from 0; got \[1\]",
            None,
        ),
        (
            {"parameters": "{truth.vibrations.rms_nm: 5}"},
            r"truth\.vibrations has no keys; it is a list of 1",
            None,
        ),
        ({"parameters": "{'truth[0]': 5}"}, "truth is no list", None),
        ({"parameters": "{truth.turbulence: 5}"}, "is not set in the configuration", None),
        ({"parameters": "{'truth.vibrations[0].kind': 5}"}, "must lead to a number", None),
        (
            {"parameters": "{truth: 5}"},
            "must lead to a number of the configuration; it is a section",
            None,
        ),
        (
            {"parameters": "{atmosphere.seeing_arcsec: 5}"},
            "atmosphere has no keys; it is not set",
            None,
        ),
        ({"parameters": "{'a b': 5}"}, "is no path in a configuration", None),
        ({"parameters": "{'': 5}"}, "is no path in a configuration", None),
        (
            {"parameters": "{error.delay: 5}"},
            "error.delay_frames and error.noise_factor; got error.delay",
            None,
        ),
        (
            {"parameters": f"{{error.noise_factor: {{fixed: 1, also: ['{ONE}']}}}}"},
            "leave also out",
            None,
        ),
        (
            {
                "parameters": f"{{'{ONE}': {{fixed: 1, also: [sensor.noise_nm]}}, sensor.noise_nm: 3}}"
            },
            "is given twice",
            None,
        ),
        ({"parameters": f"{{'{ONE}': {{fixed: 1, also: ['{ONE}']}}}}"}, "is given twice", None),
        (
            {"parameters": f"{{'{ONE}': {{uniform: [0, 5]}}}}"},
            r"parameters\.truth.*rms_nm at 0: .*greater than 0",
            None,
        ),
        (
            {"parameters": "{'truth.vibrations[0].frequency_hz': {list: [20, 30, 401]}}"},
            "at 401: .*below the Nyquist",
            None,
        ),
        ({"parameters": f"{{'{ONE}': {{normal: {{mean: 10, deviation: 20}}}}}}"}, "at -", None),
        ({"parameters": "{loop.axes: {list: [1, 1.5]}}"}, "valid integer", None),
        (
            {"parameters": "{error.delay_frames: {uniform: [-1.5, 0]}}"},
            "at -1.5: .*the real loop.*at least 1",
            None,
        ),
        ({"parameters": "{error.noise_factor: -1}"}, "the real loop.*at least 0", None),
        ({"controllers": "{9a: {design: kalman}}"}, "9a", None),
        ({"controllers": "{a b: {design: kalman}}"}, "a b", None),
        (
            {"controllers": "{a: {design: kalman}, A: {design: lqg}}"},
            "differs by more than its case",
            "controllers.A",
        ),
        (
            {"controllers": "{row_3: {design: kalman}}"},
            "names that begin with row_",
            "controllers.row_3",
        ),
        (
            {"controllers": "{sensor: {design: kalman}}", "parameters": "{sensor.noise_nm: 4}"},
            "both a parameter and a result",
            "controllers.sensor",
        ),
        ({"controllers": "{a: {}}"}, "expected exactly one of design, file", "controllers.a"),
        (
            {"controllers": "{a: {design: kalmn}}"},
            r"controllers\.a\.design: input should be 'kalman'",
            "controllers.a.design",
        ),
        (
            {"controllers": "{a: {design: kalman, file: a.fits}}"},
            "expected exactly one of design, file",
            None,
        ),
        ({"controllers": "{a: {file: a.fits, for: sample}}"}, "for goes with design", None),
        ({"controllers": "{a: {file: a.fits, gain: 0.5}}"}, "gain goes with design", None),
        (
            {"controllers": "{a: {design: kalman, gain: 0.5}}"},
            "gain goes with design: integrator",
            None,
        ),
        (
            {"controllers": "{a: {design: kalman, route: lmi}}"},
            "takes riccati or sdp; got route 'lmi'",
            None,
        ),
        ({"controllers": "{a: {design: mixed, route: lmi}}"}, "takes no route", None),
        ({"controllers": "{a: {design: polytopic}}"}, "needs half_width_hz", None),
        ({"controllers": "{a: {design: lqg, horizon: 2}}"}, "takes no horizon", None),
        (
            {"controllers": "{a: {design: hinf, gamma: 5, gamma_ratio: 2}}"},
            "at most one of gamma",
            None,
        ),
        (
            {"controllers": "{a: {design: robust}}"},
            "controllers.a: .*design.robust is missing",
            "design.robust",
        ),
        (
            {"parameters": "{loop.frame_rate_hz: {list: [700, 800, 900]}}"},
            "controllers.slow, parameters.loop.frame_rate_hz at 700: the controller must run at",
            None,
        ),
        ({"config": "none.yaml"}, "cannot read .*none.yaml", None),
        ({"config": '"a\\0.yaml"'}, "cannot read .*null byte", None),
        (
            {"parameters": "{simulation.frames: {uniform: [200, 400]}}"},
            "it is an integer, which takes a list",
            "parameters.simulation.frames",
        ),
    ],
)
def test_refusals(tmp_path, changes, message, path):
    with pytest.raises(ConfigError, match=message) as caught:
        loaded(tmp_path, **changes)
    if path is not None:
        assert caught.value.path == path


def test_a_missing_gain_file(tmp_path):
    with pytest.raises(GainFileError, match="cannot read"):
        loaded(tmp_path, controllers="{a: {file: a.fits}}")


def test_three_axes_are_refused(tmp_path):
    base = BASE.replace("axes: 1, ", "").replace(
        "noise_nm: 15.0", "noise_nm: 15.0, matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]"
    )
    base = base.replace("vibrations: [{frequency_hz: 20.0, damping: 0.01, rms_nm: 500.0}]", "")
    base = base.replace(
        "vibrations: [{kind: sinusoid, frequency_hz: 20.0, rms_nm: 500.0}]", "sensor_gain: 1.0"
    )
    with pytest.raises(ConfigError, match="one or two axes; got a loop of 3"):
        loaded(tmp_path, base=base, parameters="{truth.sensor_gain: {uniform: [0.5, 1]}}")


def test_a_drift_needs_simulation(tmp_path):
    base = BASE.replace("kind: sinusoid,", "kind: drift, end_hz: 21.0, duration_s: 1.0,")
    with pytest.raises(ConfigError, match="no exact answer; set evaluation: simulation"):
        loaded(tmp_path, base=base)
    assert loaded(tmp_path, base=base, evaluation="simulation").settings.evaluation == "simulation"


# ---------------------------------------------------------------- point by point
def test_a_point_is_what_the_library_says(tmp_path):
    study = loaded(
        tmp_path,
        samples="4",
        controllers="{fixed: {design: kalman}, told: {design: kalman, for: sample}, "
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
            vibrations=(
                lbt.models.SinusoidalVibration(
                    frequency_hz=frequency, rms_nm=500, direction=(1.0,)
                ),
            ),
            noise_nm=22.5,
            sensor_gain=0.7,
        )
        for name, design in (("fixed", fixed), ("told", lbt.kalman(plant))):
            loop = lbt.close_loop(hardware, design.controller, sensor_gain=0.7)
            budget = lbt.residual_budget(loop, truth)
            for column in ("residual_nm", "turbulence_nm", "vibration_nm", "noise_nm"):
                expected = getattr(budget, column.replace("residual", "rms"))
                assert batch.columns[f"{name}.{column}"][i] == pytest.approx(expected, rel=1e-9)
            expected = lbt.strehl(budget, config.imaging)
            assert batch.columns[f"{name}.strehl"][i] == pytest.approx(expected, rel=1e-9)
            assert batch.columns[f"{name}.stable"][i] == 1
    assert np.all(batch.columns["told.residual_nm"] < 1.05 * batch.columns["fixed.residual_nm"])


def test_unstable_loops_and_samples_that_fail(tmp_path):
    study = loaded(
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
    study = loaded(tmp_path, controllers="{a: {design: kalman}, b: {design: integrator}}")
    values = study.values(0, 3)
    values[1] = -5.0
    batch = lbt.studies.evaluate_samples(study, values, 10)
    assert [(f.row, f.controller) for f in batch.failures] == [(11, "a"), (11, "b")]
    assert "greater than 0" in batch.failures[0].error
    assert np.isnan(batch.columns["a.stable"]).tolist() == [False, True, False]


def test_simulated_samples(tmp_path):
    study = loaded(
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
