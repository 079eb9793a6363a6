"""Designs against the least residuals, and beside reference designs in the truth."""

from dataclasses import replace

import numpy as np
import pytest
from support.configs import GOOD, minimal_config, write_config

import lbt_synth as lbt
from lbt_synth.config import Config
from lbt_synth.design.result import model_limits
from lbt_synth.report.figures.studies import limits_figure
from lbt_synth.studies.limits import compare_in_truth, limits, limits_at_rate, say_residual


def test_study(config, lbt_designs):
    designs = {name: lbt_designs[name] for name in ("kalman", "hinf")}
    study = limits(designs, config.hardware, config.truth, config.imaging, errors_hz=[-3.5, 0, 3.5])
    assert (study.frequency_hz, *study.shift_hz[[0, -1]]) == (20.0, -3.5, 3.5)
    assert study.residual_nm.shape == (2, study.shift_hz.size)
    for row, curve in zip(study.rows, study.residual_nm, strict=True):
        assert row.stable
        assert curve[study.shift_hz == 0] == pytest.approx(row.residual_nm)
        assert row.worst_nm == pytest.approx(curve.max())
        assert row.worst_nm == pytest.approx(
            study.band.rms_nm * (1 + row.above_band_limit_percent / 100)
        )
    below = replace(row, values=row.values | {"above_limit_percent": -2e-14})
    assert ", 0 % above the" in say_residual("It", below, study.limit)


def test_a_loop_of_several_sensors_has_no_distance_from_the_limit_of_one(
    sensors_design, sensors_config
):
    loop = (sensors_config.hardware, sensors_config.truth, sensors_config.imaging)
    designs = {"several": sensors_design, "own": sensors_config.design("integrator")}
    several, own = limits(designs, *loop).rows
    assert several.stable
    assert np.isnan([several.above_limit_percent, own.above_limit_percent]).all()
    assert own.phase_margin_deg > 0


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


def wind_shake(folder) -> Config:
    """Return the configuration of a telescope of 39 m whose bands leave out its wind shake."""
    lines = [
        {"axis": axis, "frequency_hz": f, "damping": ratio, "rms_nm": rms}
        for axis, f, ratio, rms in (("both", 0.3, 0.09, 4700.0), ("tip", 18.0, 0.005, 140.0))
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
    config = wind_shake(tmp_path)
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


PYRAMID = GOOD["sensor"]["pyramid"]


@pytest.mark.parametrize(
    ("sensor", "rate_hz"),
    [
        *(({"pyramid": PYRAMID}, rate_hz) for rate_hz in (350.0, 1700.0)),
        ({"noise_nm": [15.5, 9.0]}, 350.0),
        ({"noise_mas": 1.5}, 1700.0),
    ],
)
def test_another_frame_rate_is_that_of_a_file_with_it(tmp_path, sensor, rate_hz):
    """The photons of a second are the same, and the variance of their noise goes as the rate."""
    config = lbt.load_config(write_config(tmp_path, {**GOOD, "sensor": sensor}))
    point = limits_at_rate(config, rate_hz)
    ((key, value),) = sensor.items()
    if key == "pyramid":
        there = {**PYRAMID, "photons": PYRAMID["photons"] * 800 / rate_hz}
    else:
        there = (np.array(value) * np.sqrt(rate_hz / 800)).tolist()
    loop = {**GOOD["loop"], "frame_rate_hz": rate_hz}
    expected = lbt.load_config(
        write_config(tmp_path, {**GOOD, "sensor": {key: there}, "loop": loop})
    )
    assert expected.hardware.delay_frames == 2
    assert point.noise_nm == pytest.approx(np.sqrt(np.mean(np.square(expected.noise_nm))))
    for name, options in (("integrator", {"phase_margin_deg": 45.0}), ("kalman", {})):
        closed = lbt.close_loop(expected.hardware, expected.design(name, **options))
        budget = lbt.residual_budget(closed, expected.truth)
        alone = budget.rms_nm, lbt.strehl(budget, expected.imaging)
        shown = point.values[f"{name}_nm"], point.values[f"{name}_strehl"]
        assert shown == pytest.approx(alone, rel=1e-6)
    assert point.limit_nm == pytest.approx(
        lbt.loop.least_residual(expected.hardware, expected.truth).rms_nm
    )
    # of a motion that is small beside the image: exp(-sigma^2) on both axes
    small = 0.845 * np.exp(-((2 * np.pi * 1e-3 * point.limit_nm / 2.2) ** 2))
    assert point.kalman_strehl < point.limit_strehl == pytest.approx(small, rel=0.02)


def test_other_sensors_are_left_out_and_coupled_modes_have_no_limit(tmp_path):
    slow = {"kind": "wavefront", "rate_hz": 400.0, "delay_frames": 1.5, "noise_nm": 5.0}
    several = lbt.load_config(write_config(tmp_path, {**GOOD, "sensors": {"slow": slow}}))
    alone = lbt.load_config(write_config(tmp_path, GOOD))
    assert several.other_sensors == "slow"
    assert limits_at_rate(several, 700.0).values == limits_at_rate(alone, 700.0).values
    shakes = {"kind": "resonance", "direction_deg": 30, "frequency_hz": 20, "damping": 0.01}
    other = {"kind": "resonance", "axis": "tip", "frequency_hz": 31, "damping": 0.01}
    lines = [{**shakes, "rms_mas": 80}, {**other, "rms_mas": 20}]
    coupled = {**GOOD, "truth": {**GOOD["truth"], "vibrations": lines}}
    point = limits_at_rate(lbt.load_config(write_config(tmp_path, coupled)), 500.0)
    assert np.isnan([point.limit_nm, point.limit_strehl]).all()
    assert point.kalman_nm < point.integrator_nm


@pytest.mark.parametrize(
    ("rate_hz", "message"),
    [(30.0, r"at 30 Hz: .*below the Nyquist frequency 15 Hz"), (500.0, "at 500 Hz: .*kind ar is")],
)
def test_a_frame_rate_without_a_model_is_refused(tmp_path, rate_hz, message):
    content = minimal_config() if rate_hz > 100 else GOOD
    config = lbt.load_config(write_config(tmp_path, content))
    with pytest.raises(lbt.errors.ConfigError, match=message):
        limits_at_rate(config, rate_hz)
