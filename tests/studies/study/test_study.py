"""Rows of a study, whichever are requested, and the distributions of its parameters."""

import pickle

import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc
from support.studies import load_small_study

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.studies.study.study import ParameterSection, unit_points

ONE = "truth.vibrations[0].rms_nm"


@pytest.mark.parametrize("sampling", ["sobol", "latin_hypercube"])
def test_rows_do_not_depend_on_who_asks(tmp_path, sampling):
    study = load_small_study(
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
    study = load_small_study(
        tmp_path,
        sampling=sampling,
        parameters=f"{{'{ONE}': {{uniform: [0.5, 1.5]}}, truth.sensor_gain: {{normal: {{mean: 1, "
        "deviation: 0.1, low: 0.5, high: 1.2}}, sensor.noise_nm: {list: [1, 5, 9]}}",
    )
    np.testing.assert_allclose(study.values(0, 3), expected, rtol=1e-12)


def test_more_samples_begin_with_the_same(tmp_path):
    few, many = (load_small_study(tmp_path, samples=n).values(0, 16) for n in ("16", "64"))
    np.testing.assert_array_equal(few, many)


@pytest.mark.parametrize("first", [0, 16_380, 40_000])
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
    cut = {"normal": {"mean": 20, "deviation": 0.5, "low": 20}}
    edge = ParameterSection.model_validate(cut).quantile(np.array([0.0]))
    assert edge.round(6).tolist() == [20.0]


def test_the_median_of_a_list_does_not_depend_on_its_order() -> None:
    read = ParameterSection.model_validate
    assert read({"list": [30.0, 10.0, 20.0]}).median() == 20
