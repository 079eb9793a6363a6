"""Robustness to frequency errors, and maps over errors of frequency, gain and delay."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.lqg import shell, slow_plant
from support.refusals import require_refusals
from support.robustness_maps import evaluate_point

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models import SinusoidalVibration
from lbt_synth.models.plant.tip_tilt import retuned_plant
from lbt_synth.report.figures.studies import tradeoff_figure
from lbt_synth.studies import robustness, robustness_map
from lbt_synth.studies.robustness import compare_on_mirror


def test_robustness_rows(config):
    rows = list(
        robustness(
            config.plant, config.truth, config.imaging, errors_hz=[-3, 0, 3], gamma_ratio=1.2
        )
    )
    assert [(r.error_hz, r.method) for r in rows] == [
        (e, m) for e in (-3, 0, 3) for m in ("kalman", "hinf")
    ]
    kalman = {r.error_hz: r for r in rows if r.method == "kalman"}
    assert kalman[0].strehl > max(kalman[-3].strehl, kalman[3].strehl)
    # the same as designing and evaluating by hand
    moved = lbt.kalman(retuned_plant(config.plant, -3, hold="driving"))
    budget = lbt.residual_budget(lbt.close_loop(moved.hardware, moved.controller), config.truth)
    assert kalman[3].residual_nm == pytest.approx(budget.rms_nm, rel=1e-9)
    for row in rows:
        parts = row.vibration_nm**2 + row.turbulence_nm**2 + row.noise_nm**2 + row.within_nm**2
        assert row.residual_nm**2 == pytest.approx(parts)
        assert row.within_nm == pytest.approx(budget.within_nm)  # no command follows it


def test_the_study_refuses_what_it_cannot_do(config):
    turbulence = config.plant.turbulence[0]
    still = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=turbulence, noise_nm=10)
    for plant, options, words in (
        (still, {"errors_hz": [0]}, "needs a vibration in the model"),
        (config.plant, {"errors_hz": [0], "methods": ["magic"]}, "method must be one of"),
        (config.plant, {"errors_hz": [25]}, "above 0"),
    ):
        with pytest.raises(ProblemError, match=words):
            next(robustness(plant, config.truth, config.imaging, **options))


CAMERA = lbt.Imaging(diameter_m=8.22, obstruction=0.11, other_modes=0.9)


def sinusoid(frequency_hz=20.0, rms_nm=797.0, direction=(1.0, 0.0)):
    return SinusoidalVibration(frequency_hz=frequency_hz, rms_nm=rms_nm, direction=direction)


def assert_as_single(design, truth, imaging, errors, gains, delays=(0.0,), rel=1e-6):
    found = robustness_map(
        design, truth, imaging, errors_hz=errors, sensor_gains=gains, delay_errors_frames=delays
    )
    assert found.stable.any()
    for i, delay in enumerate(delays):
        for j, gain in enumerate(gains):
            for k, error in enumerate(errors):
                if not found.stable[i, j]:
                    assert np.isnan(found.strehl[i, j]).all()
                    assert np.isnan(found.residual_nm[i, j]).all()
                    with pytest.raises(lbt.errors.UnstableLoopError):
                        evaluate_point(design, truth, imaging, error, gain, delay)
                    continue
                here = found.strehl[i, j, k], found.residual_nm[i, j, k]
                expected = evaluate_point(design, truth, imaging, error, gain, delay)
                assert here == pytest.approx(expected, rel=rel), (delay, gain, error)
    return found


def test_delay_errors_whole_and_fractional(air):
    truth = lbt.Truth(turbulence=air, vibrations=(sinusoid(),), noise_nm=15.5)
    lazy = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.3)
    found = assert_as_single(lazy, truth, CAMERA, [0.0, 2.0], [0.5, 1.0], [-1.0, 0.0, 0.25, 1.0])
    assert np.all(np.diff(found.strehl[:, 1, 0]) < 0)  # a later loop is a worse one


def test_unstable_points_are_nan(config, lbt_designs):
    axes = [-1, 0], [0.3, 1.0, 3.0]
    found = assert_as_single(lbt_designs["hinf"], config.truth, config.imaging, *axes)
    assert found.stable[0].tolist() == [False, True, False]


def test_an_image_that_is_gone_has_no_strehl(config, lbt_designs):
    robust = lbt_designs["hinf"]
    _, high = lbt.loop.stable_sensor_gains(robust.hardware, robust.controller)
    found = robustness_map(
        robust, config.truth, config.imaging, errors_hz=[0], sensor_gains=[high * (1 - 1e-8)]
    )
    assert found.stable.all()
    assert found.residual_nm.min() > 9e4
    assert found.strehl.max() == 0


def test_each_line_moves_by_its_share(config, lbt_designs):
    """Wind shake at 0.3 Hz stays where the line at 20 Hz moves by 3.5 Hz, or as is stated."""
    lines = (sinusoid(0.3, 400.0), sinusoid(20.0, 300.0))

    def residual(truth, error):
        axes = {"errors_hz": [error], "sensor_gains": [1]}
        found = robustness_map(lbt_designs["kalman"], truth, config.imaging, **axes)
        return float(found.residual_nm[0, 0, 0])

    def at(*frequencies):
        moved = [replace(line, frequency_hz=f) for line, f in zip(lines, frequencies, strict=True)]
        return residual(replace(config.truth, vibrations=tuple(moved)), 0.0)

    truth = replace(config.truth, vibrations=lines)
    assert residual(truth, 3.5) == pytest.approx(at(0.3 * 23.5 / 20, 23.5), rel=1e-12)
    assert residual(truth, -3.5) == pytest.approx(at(0.3 * 16.5 / 20, 16.5), rel=1e-12)
    stated = replace(truth, frequency_errors_hz=(0.1, 2.0))
    assert residual(stated, -2.0) == pytest.approx(at(0.2, 18.0), rel=1e-12)
    fixed = replace(truth, frequency_errors_hz=(0.0, 2.0))
    assert residual(fixed, -3.5) == pytest.approx(at(0.3, 16.5), rel=1e-12)


def test_the_lines_of_the_model_move_as_the_true_ones_near_them(config):
    model = [lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=50.0) for f in (0.31, 21.0)]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=config.plant.turbulence[0], vibrations=model, noise_nm=15.5
    )
    truth = replace(
        config.truth,
        vibrations=(sinusoid(0.3, 100.0), sinusoid(20.0, 100.0)),
        frequency_errors_hz=(0.0, 3.5),
    )
    (row,) = robustness(plant, truth, config.imaging, errors_hz=[2.0], methods=["kalman"])
    moved = lbt.kalman(retuned_plant(plant, [0.0, -2.0], hold="driving"))
    budget = lbt.residual_budget(lbt.close_loop(moved.hardware, moved.controller), truth)
    assert row.residual_nm == pytest.approx(budget.rms_nm, rel=1e-9)


def test_wrong_maps_are_refused(config, lbt_designs, axis_plant):
    kalman, axes = lbt_designs["kalman"], {"errors_hz": [0, 1], "sensor_gains": [1]}
    walk = lbt.EstimationProblem(A=0.99, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    three = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=3), gain=0.5)
    still = lbt.Truth(turbulence=None)

    def mapped(design=kalman, truth=config.truth, **changes):
        return partial(robustness_map, design, truth, config.imaging, **(axes | changes))

    rows = [
        (mapped(errors_hz=[]), ProblemError, "at least one number"),
        (mapped(errors_hz=[1, 1]), ProblemError, "each value once"),
        (mapped(errors_hz=[-20]), ProblemError, "moves the one at 20 Hz to 0 Hz"),
        (mapped(errors_hz=[380]), ProblemError, "between 0 and 400 Hz"),
        (mapped(sensor_gains=[0.5, 0]), ProblemError, "sensor_gains must be above 0"),
        (mapped(delay_errors_frames=[-1.5]), ProblemError, "delay_errors_frames must be at least"),
        (mapped(delay_errors_frames=[99]), ProblemError, "together must lie between 1 and 20"),
        (mapped(lbt.kalman(walk)), ProblemError, "a map needs the design of a loop"),
        (mapped(truth=still), ProblemError, "needs a vibration in the truth"),
        (mapped(lbt.kalman(axis_plant)), DimensionError, "must have 1 components"),
        (mapped(three, still), DimensionError, "got a loop of 3 modes"),
    ]
    require_refusals(rows)


def test_the_front_of_the_lbt(axis_plant):
    """A norm close to its least costs sensor-gain robustness, whichever filter has it."""
    points = list(lbt.studies.tradeoff(axis_plant, points=3, taps=8))
    for family in ("mixed", "central"):
        own = [point for point in points if point.family == family]
        gamma, rms, low = ([getattr(p, key) for p in own] for key in ("gamma", "rms", "gain_low"))
        assert gamma == sorted(gamma)
        assert rms == sorted(rms, reverse=True)
        assert low == sorted(low, reverse=True)
        assert low[0] > 0.7 > 0.1 > low[-1]
    for mixed, central in zip(points[2:-2:2], points[3:-2:2], strict=True):
        assert mixed.rms < central.rms
        assert mixed.gain_low < central.gain_low  # it tolerates more, too
    assert tradeoff_figure(points).axes[1].get_xlabel() == "H∞ norm of the estimation error [nm]"


def test_a_slow_mirror_needs_a_design_that_knows_it():
    plant = slow_plant(2.0, shell())
    truth = lbt.Truth(turbulence=plant.turbulence, vibrations=plant.vibrations, noise_nm=15.5)
    rows = {row.design: row for row in compare_on_mirror(plant, truth, CAMERA).rows}
    assert not rows["kalman, settled mirror"].stable
    assert rows["lqg"].residual_nm < 0.7 * rows["kalman, real positions"].residual_nm
