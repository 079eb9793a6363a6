"""Designs against the least residuals, and beside reference designs in the truth."""

import numpy as np
import pytest
from support.configs import minimal_config, write_config

import lbt_synth as lbt
from lbt_synth.config import Config
from lbt_synth.design.result import model_limits
from lbt_synth.report.figures.studies import limits_figure
from lbt_synth.studies.limits import compare_in_truth, limits


def test_study(config, lbt_designs):
    designs = {name: lbt_designs[name] for name in ("kalman", "hinf")}
    study = limits(designs, config.hardware, config.truth, config.imaging, errors_hz=[-3.5, 0, 3.5])
    assert study.band_hz == (16.5, 23.5)
    assert study.residual_nm.shape == (2, study.shift_hz.size)
    for row, curve in zip(study.rows, study.residual_nm, strict=True):
        assert row.stable
        assert curve[study.shift_hz == 0] == pytest.approx(row.residual_nm)
        assert row.worst_nm == pytest.approx(curve.max())
        assert row.worst_nm == pytest.approx(
            study.band.rms_nm * (1 + row.above_band_limit_percent / 100)
        )


def test_a_filter_of_several_sensors_has_no_distance_from_the_limit_of_one(
    sensors_design, sensors_config
):
    loop = (sensors_config.hardware, sensors_config.truth, sensors_config.imaging)
    designs = {"several": sensors_design, "own": sensors_config.design("integrator")}
    several, own = limits(designs, *loop).rows
    assert several.stable
    assert np.isnan(several.above_limit_percent)
    assert own.above_limit_percent > 0


def test_bad_studies(config, lbt_designs):
    good, designs = (config.hardware, config.truth, config.imaging), {"k": lbt_designs["kalman"]}
    still = limits(designs, *good)
    assert still.band is None
    for call, words in (
        (lambda: limits({}, *good), "at least one design"),
        (lambda: limits(designs, *good, errors_hz=[]), "at least one error"),
        (
            lambda: limits(designs, *good, errors_hz=[-25.0]),
            "each vibration above 0 Hz; got an error of -25",
        ),
        (lambda: limits_figure(still), "a vibration that moves"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            call()
    bare = lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    assert not model_limits(lbt.kalman(bare))


def test_a_design_of_another_making_keeps_its_name_beside_the_reference(config, lbt_designs):
    slow = config.design("integrator", gain=0.1)
    found = compare_in_truth({"kalman": slow, "best": lbt_designs["kalman"]}, config)
    assert [row.design for row in found.rows] == ["kalman", "best", "integrator", "hinf"]
    found = compare_in_truth({"kalman": slow}, config)
    assert [row.design for row in found.rows][1:] == ["integrator", "kalman (reference)", "hinf"]
    assert found.rows[2].residual_nm == pytest.approx(51.0087, abs=1e-3)
    assert found.limit.rms_nm == pytest.approx(37.7777, abs=1e-4)


def test_an_unstable_loop_is_a_warning(config):
    wild = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, delay_frames=1), gain=1.5)
    found = compare_in_truth({"wild": wild}, config)
    assert found.warnings == {"wild": ("the loop is unstable in the truth",)}
    assert not found.rows[0].stable


def test_a_reference_that_cannot_be_designed_is_a_note(tmp_path, monkeypatch):
    config = lbt.load_config(write_config(tmp_path, minimal_config()))
    slow = config.design("integrator", gain=0.3)
    design = Config.design

    def refuse(self, method, **options):
        if method == "hinf":
            raise lbt.errors.NumericalError("no convergence.")
        return design(self, method, **options)

    monkeypatch.setattr(Config, "design", refuse)
    found = compare_in_truth({"slow": slow}, config)
    assert found.notes == ("hinf is left out: no convergence.",)
    assert [row.design for row in found.rows] == ["slow", "integrator", "kalman"]


def wind_shake(folder, damping: float) -> Config:
    """Return the configuration of a telescope of 39 m whose bands leave out its wind shake."""
    lines = [
        {"axis": axis, "frequency_hz": f, "damping": ratio, "rms_nm": rms}
        for axis, f, ratio, rms in (("both", 0.3, damping, 4700.0), ("tip", 18.0, 0.005, 140.0))
    ]
    content = minimal_config(
        loop={"frame_rate_hz": 1000.0},
        model={"turbulence": {"kind": "ar2"}, "vibrations": lines},
        truth={"vibrations": [{"kind": "resonance", **line} for line in lines]},
        design={
            "robust": {
                "bands": [{"low_hz": 16.0, "high_hz": 20.0, "rms_nm": 140.0, "axis": "tip"}],
                "functions": 16,
                "states": None,
            }
        },
    ) | {
        "telescope": {"diameter_m": 39.0},
        "atmosphere": {"seeing_arcsec": 0.65, "outer_scale_m": 25.0, "wind_speed_m_s": 10.0},
    }
    return lbt.load_config(write_config(folder, content))


def test_wind_shake_that_a_robust_design_is_not_told_of(tmp_path):
    """Certified at some 20 nm, and a multiple of that in its truth."""
    config = wind_shake(tmp_path, 0.09)
    design = config.design("robust")
    found = compare_in_truth({"robust": design}, config)
    rows = {row.design: row for row in found.rows}
    robust, kalman = rows["robust"], rows["kalman"]
    promised_nm = max(design.objective_nm) * 2**0.5
    assert robust.residual_nm > 3 * promised_nm
    assert kalman.residual_nm < 1.1 * found.limit.rms_nm
    squares_nm2 = [nm**2 for nm in design.objective_nm]
    assert design.expected_residual_nm == pytest.approx(sum(squares_nm2) ** 0.5)
    (text, *_) = found.warnings["robust"]
    loop = lbt.close_loop(config.hardware, design)
    means_nm = lbt.residual_budget(loop, config.truth, frame_means=True).rms_nm
    assert text.startswith(
        f"the truth leaves {means_nm:.1f} nm in means over frames, where the design expects"
    )
    assert text.endswith("it has power that the design was not made for")
