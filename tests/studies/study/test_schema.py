"""Distributions of the parameters in a study file, against those of scipy."""

import numpy as np
from scipy import stats
from support.studies import load_small_study

from lbt_synth.studies.study.schema import ParameterSection

ONE = "truth.vibrations[0].rms_nm"


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
    weights = [1e308, 1e308, 1e308]  # their sum is infinite
    cut = {"normal": {"mean": 20, "deviation": 0.5, "low": 20}}
    edge = ParameterSection.model_validate(cut).quantile(np.array([0.0]))
    assert edge.round(6).tolist() == [20.0]
    huge = ParameterSection.model_validate({"list": [1.0, 2.0, 3.0], "weights": weights})
    assert huge.quantile(np.array([0.1, 0.5, 0.9])).tolist() == [1, 2, 3]


def test_the_median_of_a_list_does_not_depend_on_its_order() -> None:
    read = ParameterSection.model_validate
    assert read({"list": [30.0, 10.0, 20.0]}).median() == 20
    assert read({"list": [30.0, 10.0, 20.0], "weights": [5.0, 1.0, 1.0]}).median() == 30
