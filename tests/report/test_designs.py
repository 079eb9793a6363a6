"""The report of designs: its numbers are those of the library, and its page has them all."""

import hashlib
import re
from dataclasses import replace

import numpy as np
import pytest
from support.configs import with_errors
from support.design_reports import SMALL, three_designs, words_of
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
from lbt_synth.studies.limits import limits


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("report")
    (place / "small.yaml").write_text(SMALL)
    return place


@pytest.fixture(scope="module")
def config(folder):
    return lbt.load_config(folder / "small.yaml")


@pytest.fixture(scope="module")
def few(folder):
    """The same with few errors and gains, for what does not depend on them."""
    text = with_errors(SMALL, -2, 2)
    (folder / "few.yaml").write_text(re.sub(r"sensor_gains: .*", "sensor_gains: [0.5, 1.0]", text))
    return lbt.load_config(folder / "few.yaml")


@pytest.fixture(scope="module")
def designs(config):
    return three_designs(config)


@pytest.fixture(scope="module")
def report(config, designs):
    return design_report(config, designs)


@pytest.fixture(scope="module")
def text(report, folder):
    lbt.report.write_page(report_page(report, {}), folder / "a.html")
    return (folder / "a.html").read_text()


def test_the_numbers_are_those_of_the_library(report, config, designs):
    study = limits(
        designs,
        config.hardware,
        config.truth,
        config.imaging,
        errors_hz=config.settings.robustness.errors_hz,
    )
    (rejections,) = (c.figure for c in report_page(report, {}).charts if c.key == "sigma")
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
        assert one.worst_strehl == one.map.strehl[0, gains[1]].min()
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
    one = design_report(config, {"wrong": wrong}).assessments[0]
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
    assert len(re.split(r"(?<=[a-z%]\.) |(?<=them\.) ", words)) <= 3
    table = {row[0]: row[1:] for row in summary_table(report).rows if len(row) > 1}
    assert table["worst Strehl ratio [%]"] == (*(f"{v:.2f}" for v in worst.values()), "-")
    assert "ertificates that do NOT hold: wild." in words


def test_an_unstable_loop_is_named_loudly(report, text):
    wild = report.assessments[2]
    assert not wild.stable
    assert wild.loop.spectral_radius > 1
    assert wild.budget is None
    assert wild.margins is None
    # an integrator of 1.5 in two frames is stable below 1 / 1.5
    assert wild.sensor_gains == pytest.approx((0.0, 2 / 3), abs=1e-6)
    assert not wild.certified  # its loop at the assumed gain, recomputed
    reader = Reader(text)
    notices = [a for a in reader.named("p") if "bad" in (a.get("class") or "")]
    assert len(notices) == 2
    assert "wild is UNSTABLE in the loop of this configuration" in text
    assert "The certificate of wild fails: spectral radius of the closed loop" in text
    assert "UNSTABLE in this loop: wild; certificates that do NOT hold: wild." in verdict(report)
    assert text.count("wild: unstable") > 3


def test_a_limit_of_nothing_is_no_limit(config, designs):
    still = lbt.Truth(turbulence=None, noise_nm=config.truth.noise_nm)
    report = design_report(replace(config, truth=still), {"slow": designs["slow"]})
    assert report.limits.limit.rms_nm == 0
    assert "above the limit" not in words_of(report)
    assert "passed, 1 check " in words_of(report) + " "


def test_the_page_is_complete(text, report, config):
    reader = Reader(text)
    titles = " ".join(reader.texts["h2"] + reader.texts["h3"])
    for word in (
        "Summary",
        "Estimation error, rejection and noise",
        "Loop gain and margins",
        "Residual over the frequency error",
        "Step response",
        "Certificates",
        "Files and versions",
    ):
        assert word in titles
    for heading in (
        "method, computed by",
        "Strehl ratio, exact [%]",
        "modulus margin",
        "states of the controller",
        "stable real sensor gains",
        "certificate, recomputed",
    ):
        assert heading in reader.texts["th"]
    kalman = report.assessments[0]
    cells = reader.texts["td"]
    assert f"{kalman.limits.residual_nm:.1f}" in cells
    assert f"{100 * kalman.limits.strehl:.2f}" in cells
    assert hashlib.sha256(config.source.read_bytes()).hexdigest() in cells
    assert lbt.__version__ in cells
    assert "# The adaptive optics of the Large Binocular Telescope" in reader.texts["code"][0]
    assert reader.texts["code"][0] == SMALL
    assert len(text) < 5e6
    for figure in reader.named("figure"):
        assert figure["id"] in {a["href"][1:] for a in reader.named("a")}


def test_a_truth_without_vibrations(config, designs):
    calm = replace(config, truth=replace(config.truth, vibrations=()))
    report = design_report(calm, {"slow": designs["slow"]})
    assert report.errors_hz.tolist() == [0.0]
    page = report_page(report, {}, "calm")
    assert [chart.key for chart in page.charts] == ["sigma", "bode", "step"]
    assert page.title == "calm"
    assert verdict(report).startswith("slow leaves ")


def test_nothing_stable_is_needed(config, designs):
    report = design_report(config, {"wild": designs["wild"]})
    text = words_of(report)
    charts = report_page(report, {}).charts
    assert [chart.key for chart in charts] == ["map"]  # none of them is empty
    honest = replace(report.assessments[0], checks=())
    assert "passed, but they are about the loops that the designs were made for" in verdict(
        replace(report, assessments=(honest,))
    )
    assert "No loop is stable, so none has a rejection" in text
    assert " leaves " not in verdict(report)


def test_a_certificate_that_cannot_be_computed(few, monkeypatch):
    slow = lbt.integrator(few.hardware, gain=0.4)

    def broken(self):
        raise lbt.errors.NumericalError("the norm did not settle.")

    monkeypatch.setattr(type(slow), "recertify", broken)
    report = design_report(few, {"slow": slow})
    assert not report.assessments[0].certified
    text = words_of(report)
    assert "The certificate of slow fails: the norm did not settle." in text
    assert "slow: not computed: the norm did not settle." in text
    assert "NOT COMPUTED" in text


def test_one_page_has_designs_of_several_sensors_and_of_one(
    sensors_design, sensors_file, sensors_config
):
    designs = {"both": sensors_design, "own": lbt.integrator(sensors_config.hardware, gain=0.3)}
    files = {"both": sensors_file}
    report = design_report(sensors_config, designs)
    page = report_page(report, files)
    text = page_html(page).decode()
    assert "both: When sensors fail" in text
    for source in (sensors_file, sensors_config.source):
        assert hashlib.sha256(source.read_bytes()).hexdigest() in text
    both, own = report.assessments
    limit = report.limits.limit.rms_nm
    assert both.limits.residual_nm < limit < own.limits.residual_nm
    assert f"alone leaves less than {limit:.1f}" in text
    assert verdict(report).startswith(f"both leaves {both.limits.residual_nm:.1f}")
    assert "own keeps the highest Strehl ratio at worst" in verdict(report)
    assert len(page.charts) == 5
