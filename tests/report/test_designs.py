"""The report of designs: its numbers are those of the library, and its page has them all."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from support.pages import Reader

import lbt_synth as lbt
from lbt_synth.design import Certificate, Check
from lbt_synth.report.designs import (
    design_facts,
    design_report,
    frequency_errors,
    report_page,
    summary_table,
    verdict,
)
from lbt_synth.report.draw import figure_series
from lbt_synth.report.page.html import page_html


@pytest.fixture(scope="module")
def report(small_config, small_designs):
    return design_report(small_config, small_designs)


@pytest.fixture(scope="module")
def page(report):
    return report_page(report, {})


def test_the_numbers_are_those_of_the_library(report, page, small_config):
    config, axes = small_config, {"errors_hz": [-1.75, 0.0], "sensor_gains": [0.5, 1.0]}
    (rejections,) = (c.figure for c in page.charts if c.key == "sigma")
    curves = {s.name: s for s in figure_series(rejections) if "phase" in s.panel}
    for one in report.stable:
        row, controller = one.limits, one.design.controller
        loop = lbt.close_loop(config.hardware, controller)
        budget = lbt.residual_budget(loop, config.truth)
        assert row.residual_nm == pytest.approx(budget.rms_nm, rel=1e-9)
        above = row.residual_nm / report.limits.limit.rms_nm - 1
        assert row.above_limit_percent == pytest.approx(100 * above)
        assert row.strehl == pytest.approx(lbt.strehl(budget, config.imaging), rel=1e-9)
        assert one.margins == lbt.loop_margins(loop)
        gains = lbt.loop.stable_sensor_gains(config.hardware, controller)
        assert one.sensor_gains == pytest.approx(gains, rel=1e-9)
        points = lbt.studies.robustness_map(one.design, config.truth, config.imaging, **axes)
        places = (np.searchsorted(getattr(one.map, key), axes[key]) for key in reversed(axes))
        cut = one.map.strehl[0][np.ix_(*places)]
        assert cut == pytest.approx(points.strehl[0], rel=1e-9)
        assert one.worst_strehl == one.map.strehl[0, one.map.sensor_gains == 1.0].min()
        peak = np.linalg.norm(loop.sensitivity(curves[one.name].x), 2, axis=(1, 2))
        assert curves[one.name].y == pytest.approx(peak, rel=1e-9)
    kalman = report.assessments[0]
    row = design_facts(report, kalman)
    assert (row.gamma, row.estimation_rms) == (kalman.design.gamma, kalman.design.rms)
    assert kalman.checks == kalman.design.recertify().checks


def test_errors_that_would_leave_the_band_are_left_out(small_config):
    line = lbt.models.SinusoidalVibration(frequency_hz=2.0, rms_nm=10)
    low = replace(small_config, truth=replace(small_config.truth, vibrations=(line,)))
    errors = frequency_errors(low)
    assert -2.0 < errors[0] < -1.0
    assert errors[-1] == 3.5
    assert frequency_errors(small_config) == pytest.approx(np.linspace(-3.5, 3.5, 9))


def test_a_design_that_was_tampered_with_fails(small_config, small_designs):
    kalman, believed = small_designs["kalman"], Check("believe me", 0, 1, "none")
    certificate = Certificate(checks=(believed,), gamma=1.0, rms_per_output=np.ones(2))
    gain = 1.1 * np.asarray(kalman.gain_predictor)
    wrong = replace(kalman, gain_predictor=gain, certificate=certificate)
    one = design_report(small_config, {"wrong": wrong}).assessments[0]
    assert not one.certified
    assert "believe me" not in [check.name for check in one.checks]


def test_the_verdict_is_made_of_the_numbers(report):
    words = verdict(report).replace("\u00a0", " ")
    kalman, slow, _ = report.assessments
    assert words.startswith(f"kalman leaves {kalman.limits.residual_nm:.1f} nm rms in the truth")
    assert f"Strehl ratio {100 * kalman.limits.strehl:.1f} %" in words
    worst = {one.name: 100 * one.worst_strehl for one in (kalman, slow)}
    best = max(worst, key=worst.get)
    assert f"{best} keeps the highest Strehl ratio at worst, {worst[best]:.1f} %, if" in words
    table = {row[0]: row[1:] for row in summary_table(report).rows if len(row) > 1}
    assert table["worst Strehl ratio [%]"] == (*(f"{v:.2f}" for v in worst.values()), "-")
    assert words.endswith("UNSTABLE in this loop: wild; certificates that do NOT hold: wild.")


def test_the_page_has_the_numbers_and_names_an_unstable_loop_loudly(report, page, small_config):
    kalman, _, wild = report.assessments
    assert wild.loop.spectral_radius > 1
    assert (wild.stable, wild.budget, wild.margins) == (False, None, None)
    # an integrator of 1.5 in two frames is stable below 1 / 1.5
    assert wild.sensor_gains == pytest.approx((0.0, 2 / 3), abs=1e-6)
    assert not wild.certified  # its loop at the assumed gain, recomputed
    text = page_html(page).decode()
    reader = Reader(text)
    notices = [a for a in reader.named("p") if "bad" in (a.get("class") or "")]
    assert len(notices) == 2
    assert "wild is UNSTABLE in the loop of this configuration" in text
    assert text.count("wild: unstable") > 3
    numbers = {f"{kalman.limits.residual_nm:.1f}", f"{100 * kalman.limits.strehl:.2f}"}
    assert numbers <= {*reader.texts["td"]}
    assert reader.texts["code"][0] == small_config.source.read_text()
    assert len(text) < 5e6
    links = {a["href"][1:] for a in reader.named("a")}
    assert {figure["id"] for figure in reader.named("figure")} <= links


def test_a_limit_of_nothing_is_no_limit(small_config, small_designs):
    still = lbt.Truth(turbulence=None, noise_nm=small_config.truth.noise_nm)
    config = replace(small_config, truth=still)
    report = design_report(config, {"slow": small_designs["slow"]})
    assert report.limits.limit.rms_nm == 0
    assert "above the limit" not in repr(summary_table(report).rows)


def test_a_truth_without_vibrations(small_config, small_designs):
    calm = replace(small_config, truth=replace(small_config.truth, vibrations=()))
    report = design_report(calm, {"slow": small_designs["slow"]})
    assert report.errors_hz.tolist() == [0.0]
    assert [chart.key for chart in report_page(report, {}).charts] == ["sigma", "bode", "step"]
    assert verdict(report).startswith("slow leaves ")


def test_nothing_stable_is_needed(small_config, small_designs):
    report = design_report(small_config, {"wild": small_designs["wild"]})
    charts = report_page(report, {}).charts
    assert [chart.key for chart in charts] == ["map"]  # none of them is empty
    honest = replace(report, assessments=(replace(report.assessments[0], checks=()),))
    assert "passed, but they are about the loops that the designs were made for" in verdict(honest)
    assert " leaves " not in verdict(report)


def test_a_certificate_that_cannot_be_computed(small_config, small_designs, monkeypatch):
    slow = small_designs["slow"]

    def broken(self):
        raise lbt.errors.NumericalError("the norm did not settle.")

    monkeypatch.setattr(type(slow), "recertify", broken)
    report = design_report(small_config, {"slow": slow})
    assert not report.assessments[0].certified
    words = repr(report_page(report, {}).blocks)
    assert "The certificate of slow fails: the norm did not settle." in words
    assert "NOT COMPUTED" in words


def test_one_page_has_designs_of_several_sensors_and_of_one(
    sensors_design, sensors_file, sensors_config, monkeypatch
):
    monkeypatch.setattr("lbt_synth.studies.limits._GRID", 3)  # points of a curve
    designs = {"both": sensors_design, "own": lbt.integrator(sensors_config.hardware, gain=0.3)}
    report = design_report(sensors_config, designs)
    page = report_page(report, {"both": sensors_file})
    for source in (sensors_file, sensors_config.source):
        assert page.digests[source.name] == hashlib.sha256(source.read_bytes()).hexdigest()
    residuals_nm = [one.limits.residual_nm for one in report.assessments]
    limit_nm = report.limits.limit.rms_nm
    assert residuals_nm[0] < limit_nm < residuals_nm[1]
    assert f"alone leaves less than {limit_nm:.1f}" in repr(page.blocks)
    words = verdict(report)
    assert words.startswith(f"both leaves {residuals_nm[0]:.1f}")
    assert "own keeps the highest Strehl ratio at worst" in words
    assert len(page.charts) == 5
