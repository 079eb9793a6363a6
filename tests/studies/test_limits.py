"""The study of limits: designs against the least residuals."""

from dataclasses import replace

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design.result import model_limits
from lbt_synth.report.figures.studies import limits_figure


def test_study(config):
    designs = {
        "kalman": lbt.kalman(config.plant),
        "hinf": lbt.hinf(config.plant, gamma_ratio=1.2, route="riccati"),
    }
    study = lbt.studies.limits(
        designs, config.hardware, config.truth, config.imaging, errors_hz=[-3.5, 0, 3.5]
    )
    assert study.band_hz == (16.5, 23.5)
    assert study.residual_nm.shape == (2, study.shift_hz.size)
    for row, curve in zip(study.rows, study.residual_nm, strict=True):
        assert row.stable
        assert curve[study.shift_hz == 0] == pytest.approx(row.residual_nm)
        assert row.worst_nm == pytest.approx(curve.max())
        assert row.worst_nm == pytest.approx(
            study.band.rms_nm * (1 + row.above_band_limit_percent / 100)
        )
    (axis,) = limits_figure(study).axes
    assert axis.get_xlabel() == "frequency of the true vibration [Hz]"
    assert axis.get_ylabel() == "residual [nm rms]"
    assert len({str(line.get_linestyle()) for line in axis.get_lines()[:2]}) == 2


def test_study_of_an_unstable_design(config):
    designs = {"low": lbt.hinf(config.plant, gamma_ratio=1.05, route="riccati")}
    truth = replace(config.truth, sensor_gain=0.3)
    study = lbt.studies.limits(designs, config.hardware, truth, config.imaging, errors_hz=[-1, 1])
    (row,) = study.rows
    assert not row.stable
    assert np.isnan([row.residual_nm, row.strehl, row.worst_nm, row.above_limit_percent]).all()
    limits_figure(study)


def test_a_filter_of_several_sensors_has_no_distance_from_the_limit_of_one(
    sensors_design, sensors_config
):
    loop = (sensors_config.hardware, sensors_config.truth, sensors_config.imaging)
    designs = {"several": sensors_design, "own": sensors_config.design("integrator")}
    several, own = lbt.studies.limits(designs, *loop).rows
    assert several.stable
    assert np.isnan(several.above_limit_percent)
    assert own.above_limit_percent > 0


def test_bad_studies(config):
    good, designs = (config.hardware, config.truth, config.imaging), {"k": lbt.kalman(config.plant)}
    still = lbt.studies.limits(designs, *good)
    assert still.band is None
    for call, words in (
        (lambda: lbt.studies.limits({}, *good), "at least one design"),
        (lambda: lbt.studies.limits(designs, *good, errors_hz=[]), "at least one error"),
        (
            lambda: lbt.studies.limits(designs, *good, errors_hz=[-25.0]),
            "each vibration above 0 Hz; got an error of -25",
        ),
        (lambda: limits_figure(still), "a vibration that moves"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            call()


@pytest.mark.parametrize("delay", [1, 2.7])
def test_designs_of_the_full_form_have_the_limits_of_their_plant(delay):
    plant = lbt_axis_plant(delay_frames=delay, modes=2)
    values = model_limits(lbt.kalman(plant)).values()
    assert [*model_limits(lbt.kalman(plant.full())).values()] == pytest.approx([*values], rel=1e-7)
    bare = lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    assert not model_limits(lbt.kalman(bare))
