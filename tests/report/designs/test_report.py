"""The numbers of a report are those of the library."""

import re
from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.design import Certificate, Check
from lbt_synth.report.designs.page import design_page
from lbt_synth.report.designs.report import (
    design_facts,
    frequency_errors,
    good_range,
    summary_table,
    verdict,
)
from lbt_synth.report.draw import figure_series
from lbt_synth.report.figures.records import exact_spectrum, run_spectra
from lbt_synth.studies.limits import limits


def test_the_numbers_are_those_of_the_library(report, config, designs):
    study = limits(
        designs,
        config.hardware,
        config.truth,
        config.imaging,
        errors_hz=config.settings.robustness.errors_hz,
    )
    (rejections,) = (c.figure for c in design_page(report).charts if c.key == "sigma")
    for one, limit in zip(report.assessments, study.rows, strict=True):
        row = one.limits
        assert row.residual_nm == pytest.approx(limit.residual_nm, rel=1e-9, nan_ok=True)
        assert row.above_limit_percent == pytest.approx(limit.above_limit_percent, nan_ok=True)
        if not one.stable:
            continue
        loop = lbt.close_loop(config.hardware, one.design.controller)
        budget = lbt.residual_budget(loop, config.truth)
        assert row.residual_nm == pytest.approx(budget.rms_nm, rel=1e-9)
        assert row.strehl == pytest.approx(lbt.strehl(budget, config.imaging), rel=1e-9)
        assert one.margins == lbt.loop_margins(loop)
        low, high = lbt.loop.stable_sensor_gains(config.hardware, one.design.controller)
        assert one.sensor_gains == pytest.approx((low, high), rel=1e-9)
        found = lbt.studies.robustness_map(
            one.design, config.truth, config.imaging, errors_hz=[-2.0, 0.0], sensor_gains=[0.5, 1.0]
        )
        at = [int(np.flatnonzero(one.map.errors_hz == e)[0]) for e in (-2.0, 0.0)]
        gains = [int(np.flatnonzero(one.map.sensor_gains == g)[0]) for g in (0.5, 1.0)]
        assert one.map.strehl[0][np.ix_(gains, at)] == pytest.approx(found.strehl[0], rel=1e-9)
        assert one.strehls[at] == pytest.approx(found.strehl[0, 1], rel=1e-9)
        series = next(
            s for s in figure_series(rejections) if (s.name, "phase" in s.panel) == (one.name, True)
        )
        peak = np.linalg.norm(loop.sensitivity(series.x), 2, axis=(1, 2))
        assert series.y == pytest.approx(peak, rel=1e-9)
    kalman = report.assessments[0]
    row = design_facts(report, kalman)
    assert (row.gamma, row.estimation_rms) == (kalman.design.gamma, kalman.design.rms)
    assert kalman.checks == designs["kalman"].recertify().checks


def test_errors_that_would_leave_the_band_are_left_out(config):
    line = lbt.models.SinusoidalVibration(frequency_hz=2.0, rms_nm=10)
    low = replace(config, truth=replace(config.truth, vibrations=(line,)))
    errors = frequency_errors(low)
    assert -2.0 < errors[0] < -1.0
    assert errors[-1] == 3.5
    assert np.all(np.diff(errors) > 0)
    assert frequency_errors(config)[[0, -1]].tolist() == [-3.5, 3.5]


def test_a_design_that_was_tampered_with_fails(config, designs):
    kalman = designs["kalman"]
    wrong = replace(
        kalman,
        gain_predictor=1.1 * np.asarray(kalman.gain_predictor),
        certificate=Certificate(
            checks=(Check(name="believe me", value=0, limit=1, computed_by="none"),),
            gamma=1.0,
            rms_per_output=np.ones(2),
        ),
    )
    one = lbt.report.design_report(config, {"wrong": wrong}).assessments[0]
    assert not one.certified
    assert "believe me" not in [check.name for check in one.checks]


def test_the_verdict_is_made_of_the_numbers(report):
    words = verdict(report).replace("\u00a0", " ")
    kalman, slow, _ = report.assessments
    assert f"Least residual: kalman, {kalman.limits.residual_nm:.1f} nm rms" in words
    assert f"Strehl ratio {100 * kalman.limits.strehl:.1f} %" in words
    worst = {one.name: 100 * np.min(one.strehls) for one in (kalman, slow)}
    best = max(worst, key=worst.get)
    assert f"are wrong by -3.5 to +3.5 Hz: {best}, {worst[best]:.1f} %." in words
    assert len(re.split(r"(?<=[a-z%]\.) |(?<=them\.) ", words)) <= 3
    table = {row[0]: row[1:] for row in summary_table(report).rows if len(row) > 1}
    assert table["worst Strehl ratio [%]"] == (*(f"{v:.2f}" for v in worst.values()), "-")
    low_hz, high_hz = good_range(report, kalman)
    strehls, errors = kalman.strehls, report.errors_hz
    inside = (errors >= low_hz) & (errors <= high_hz)
    assert np.all(strehls[inside] >= 0.9 * strehls.max())
    outside = np.flatnonzero(np.diff(inside.astype(int)))
    for edge in outside:
        assert min(strehls[edge], strehls[edge + 1]) < 0.9 * strehls.max()
    inside = table["within 10 % of its best Strehl ratio [Hz]"]
    assert inside[0] == f"{low_hz:+.4g} to {high_hz:+.4g}"
    assert good_range(report, report.assessments[2]) is None
    assert "ertificates that do NOT hold: wild." in words


def test_simulations_agree_with_the_exact_answer(report):
    for one in report.stable:
        exact = lbt.residual_budget(one.loop, report.config.truth)
        residual_nm = np.sqrt(np.mean(one.run.rms_nm**2))
        assert residual_nm == pytest.approx(exact.rms_nm, rel=0.15)
        f, _, simulated = run_spectra(one.run)
        length = one.run.residual_nm.shape[1]
        expected = exact_spectrum(one.loop, report.config.truth, f, length)
        ratio = (simulated / expected)[f > 5]
        assert np.mean(ratio) == pytest.approx(1, abs=0.06)
        assert np.ptp(one.run.strehl(report.config.imaging)) > 0
