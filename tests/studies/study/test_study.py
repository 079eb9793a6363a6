"""Study files: what they say, what is refused, and the rows of their samples."""

import pickle

import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc
from support.studies import BASE, load_small_study, study_file

import lbt_synth as lbt
from lbt_synth.design import integrator
from lbt_synth.errors import ConfigError, ProblemError
from lbt_synth.studies.study.study import ParameterSection, unit_points

ONE = "truth.vibrations[0].rms_nm"


def test_rows_do_not_depend_on_who_asks(tmp_path):
    study = load_small_study(
        tmp_path,
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


FOR_EVER = [  # computed once
    (0.6132053462788463, 1.133682976967863, 9.0),
    (1.425886674784124, 0.8811522781022142, 1.0),
]


def test_rows_for_ever(tmp_path):
    """A study that was begun must go on with the same rows, in later versions too."""
    study = load_small_study(
        tmp_path,
        parameters=f"{{'{ONE}': {{uniform: [0.5, 1.5]}}, truth.sensor_gain: {{normal: {{mean: 1, "
        "deviation: 0.1, low: 0.5, high: 1.2}}, sensor.noise_nm: {list: [1, 5, 9]}}",
    )
    np.testing.assert_allclose(study.values(0, 2), FOR_EVER, rtol=1e-12)


@pytest.mark.parametrize("first", [16_380, 40_000])
def test_points_are_those_of_one_long_sequence(tmp_path, first):
    settings = load_small_study(tmp_path, samples=str(1 << 17)).settings
    engine = qmc.Sobol(3, scramble=True, seed=np.random.default_rng(settings.seed))
    expected = engine.random(1 << 16)[first : first + 20_000]
    points = unit_points(settings, 3, first, first + 20_000)
    np.testing.assert_array_equal(points, expected)


def test_distributions(tmp_path):
    study = load_small_study(
        tmp_path,
        samples="4096",
        parameters=f"{{'{ONE}': {{uniform: [100, 300]}}, "
        "'model.vibrations[0].rms_nm': {normal: {mean: 400, deviation: 50}}, "
        "'truth.vibrations[0].frequency_hz': {normal: {mean: 20, deviation: 1, low: 19.5, high: 23}},"
        "sensor.noise_nm: {list: [10, 20, 30, 30]}, "
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
    cut = {"normal": {"mean": 20, "deviation": 0.5, "low": 20}}
    edge = ParameterSection.model_validate(cut).quantile(np.array([0.0]))
    assert edge.round(6).tolist() == [20.0]


def test_controllers(tmp_path):
    folder = tmp_path / "gains"
    folder.mkdir()
    made = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.4)
    lbt.save_gain(folder / "a.fits", made)
    study = load_small_study(
        tmp_path,
        controllers="{a: {file: gains/a.fits}, b: {design: kalman}, c: {design: hinf, gamma_ratio: "
        "1.5, for: sample}, d: {design: integrator}}",
    )
    a, b, c, d = study.controllers.values()
    assert a.gain == 0.4
    assert b.certificate.passed
    assert (c.method.name, c.given) == ("hinf", {"gamma_ratio": 1.5})
    assert list(study.designed) == ["b", "d"]
    origins = [section.text for section in study.settings.controllers.values()]
    assert origins[:3] == [
        "gains/a.fits",
        "kalman for the configuration",
        "hinf (gamma_ratio 1.5) for each sample",
    ]
    assert d.gain == integrator(study.config.hardware, truth=study.config.truth).gain
    columns = "strehl residual_nm turbulence_nm vibration_nm noise_nm within_nm stable"
    assert study.result_columns[:7] == tuple(f"a.{name}" for name in columns.split())
    assert study.columns[:2] == ("row", ONE)
    assert [path.name for path in study.inputs] == ["study.yaml", "base.yaml", "a.fits"]


def test_the_digest_is_of_what_decides_the_results(tmp_path):
    first = load_small_study(tmp_path).digest
    study_file(tmp_path).write_text("# a comment\n" + (tmp_path / "study.yaml").read_text())
    assert lbt.studies.load_study(tmp_path / "study.yaml").digest == first
    assert load_small_study(tmp_path, seed="4").digest != first
    assert load_small_study(tmp_path, base=BASE.replace("15.0", "15.1")).digest != first
    digests = set()
    for gain in (0.4, 0.5):
        made = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=gain)
        lbt.save_gain(tmp_path / "a.fits", made)
        digests.add(load_small_study(tmp_path, controllers="{a: {file: a.fits}}").digest)
    assert len(digests) == 2


# what is written in place of a key, or for the parameter ONE; what is said; the path of the error
REFUSALS = r"""
samplse: 5 => unknown key samplse; did you mean samples => samplse
samples: => the key samples is missing => samples
ONE: {unifrom: [1, 2]} => unknown key parameters\.truth\.vibrations\[0\]\.rms_nm\.unifrom; did you mean uniform => parameters.truth.vibrations[0].rms_nm.unifrom
ONE: {uniform: [2, 1]} => must be \[low, high\]; got \[2, 1\]
ONE: {fixed: 1, list: [2]} => expected a number or exactly one
ONE: {normal: {mean: 1, deviation: 1, low: 3, high: 2}} => low must be below high
parameters: {'truth.vibration[0].rms_nm': 5} => no vibration there; did you mean vibrations
parameters: {truth.vibrations.rms_nm: 5} => no rms_nm there; it is a list of 1
parameters: {truth.turbulence: 5} => is not set in the configuration
parameters: {truth: 5} => must lead to a number; got a dict
parameters: {'a b': 5} => is no path in a configuration
parameters: {error.delay: 5} => error.delay_frames and error.noise_factor; got error.delay
parameters: {error.noise_factor: {fixed: 1, also: ['truth.vibrations[0].rms_nm']}} => leave also out
ONE: {fixed: 1, also: [sensor.noise_nm]}, sensor.noise_nm: 3 => is given twice
ONE: {uniform: [0, 5]} => parameters\.truth.*rms_nm at 0: .*greater than
parameters: {'truth.vibrations[0].frequency_hz': {list: [20, 30, 401]}} => at 401: .*below the Nyquist
parameters: {error.delay_frames: {uniform: [-1.5, 0]}} => at -1.5: .*the real loop.*at least 1
controllers: {a: {design: kalman}, A: {design: lqg}} => differs by more than its case => controllers.A
controllers: {row_3: {design: kalman}} => names that begin with row_ => controllers.row_3
controllers: {sensor: {design: kalman}} & parameters: {sensor.noise_nm: 4} => both a parameter and a result => controllers.sensor
controllers: {a: {design: kalmn}} => controllers\.a\.design: method must be one of .*Did you mean kalman\? => controllers.a.design
controllers: {a: {design: kalman, gain: 0.5}} => gain goes with method integrator
parameters: {loop.frame_rate_hz: {list: [700, 800, 900]}} => controllers.slow, parameters.loop.frame_rate_hz at 700: the controller must run at
parameters: {simulation.frames: {uniform: [200, 400]}} => it is an integer, which takes a list => parameters.simulation.frames
"""


@pytest.mark.parametrize("line", REFUSALS.strip().splitlines())
def test_refusals(tmp_path, line):
    written, message, *path = line.split(" => ")
    changes = {}
    for entry in written.split(" & "):
        key, _, value = entry.partition(":")
        if key == "ONE":
            key, value = "parameters", f"{{'{ONE}': {value}}}"
        changes[key] = value.strip() or None
    with pytest.raises(ConfigError, match=message) as caught:
        load_small_study(tmp_path, **changes)
    assert path in ([], [caught.value.path])


def test_a_drift_has_no_exact_answer(tmp_path):
    base = BASE.replace("kind: sinusoid,", "kind: drift, end_hz: 21.0, duration_s: 1.0,")
    with pytest.raises(ConfigError, match="no exact answer; give it one frequency"):
        load_small_study(tmp_path, base=base)
