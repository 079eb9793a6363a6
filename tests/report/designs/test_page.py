"""The report of designs as a page: it has all that it should, and says loudly what is wrong."""

import hashlib
from dataclasses import replace

import pytest
from support.commands import run
from support.design_reports import SMALL, words_of
from support.pages import Reader
from support.several_sensors import write_config

import lbt_synth as lbt
from lbt_synth.report.designs.page import design_page
from lbt_synth.report.designs.report import verdict
from lbt_synth.report.page.html import page_html
from lbt_synth.storage.tables import Table


def test_an_unstable_loop_is_named_loudly(report, text):
    wild = report.assessments[2]
    assert not wild.stable
    assert wild.loop.spectral_radius > 1
    assert wild.budget is None
    assert wild.margins is None
    assert wild.run is None
    # an integrator of 1.5 in two frames is stable below 1 / 1.5
    assert wild.sensor_gains == pytest.approx((0.0, 2 / 3), abs=1e-6)
    assert not wild.certified  # its loop at the assumed gain, recomputed
    reader = Reader(text)
    notices = [a for a in reader.named("p") if "bad" in (a.get("class") or "")]
    assert len(notices) == 2
    assert "wild is UNSTABLE in the loop of this configuration" in text
    assert "The certificate of wild fails: spectral radius of the closed loop" in text
    assert "UNSTABLE in this loop: wild; certificates that do NOT hold: wild." in verdict(report)
    assert 'class="bad">UNSTABLE' in text
    assert text.count("wild: unstable") > 5


def test_a_limit_of_nothing_is_no_limit(config, designs):
    still = lbt.Truth(turbulence=None, noise_nm=config.truth.noise_nm)
    report = lbt.report.design_report(replace(config, truth=still), {"slow": designs["slow"]})
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
        "Strehl ratio over the frequency error",
        "Poles",
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
    report = lbt.report.design_report(calm, {"slow": designs["slow"]})
    assert report.errors_hz.tolist() == [0.0]
    page = design_page(report, title="calm")
    assert "sensor-gain" in [chart.key for chart in page.charts]
    assert page.title == "calm"
    assert "Truth" in [block.caption for block in page.blocks if isinstance(block, Table)]
    assert "Least residual: slow, " in verdict(report)


def test_nothing_stable_is_needed(config, designs):
    report = lbt.report.design_report(config, {"wild": designs["wild"]})
    text = words_of(report)
    charts = design_page(report).charts
    assert [chart.key for chart in charts] == ["map", "poles"]  # none of them is empty
    honest = replace(report.assessments[0], checks=())
    assert "passed, but they are about the loops that the designs were made for" in verdict(
        replace(report, assessments=(honest,))
    )
    assert "No loop is stable, so none was simulated." in text
    assert "No loop is stable, so none has a rejection" in text
    assert "Least residual" not in text


def test_a_certificate_that_cannot_be_computed(few, monkeypatch):
    slow = lbt.integrator(few.hardware, gain=0.4)

    def broken(self):
        raise lbt.errors.NumericalError("the norm did not settle.")

    monkeypatch.setattr(type(slow), "recertify", broken)
    report = lbt.report.design_report(few, {"slow": slow})
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
    report = lbt.report.design_report(sensors_config, designs, gain_files=files)
    page = design_page(report)
    text = page_html(page).decode()
    assert "both: When sensors fail" in text
    for source in (sensors_file, sensors_config.source):
        assert hashlib.sha256(source.read_bytes()).hexdigest() in text
    assert "each sensor missing in turn" in text
    both, own = report.assessments
    limit = report.limits.limit.rms_nm
    assert both.limits.residual_nm < limit < own.limits.residual_nm
    assert f"alone leaves less than {limit:.1f}" in text
    assert f"Least residual: both, {both.limits.residual_nm:.1f}" in verdict(report)
    assert "Hz, of one sensor: own, " in verdict(report).replace("\u00a0", " ")
    charts = {chart.key: chart.figure for chart in page.charts}
    assert [len(charts[f"simulation-{i}"].axes[1].lines) for i in (1, 2)] == [2, 3]
    assert len(charts["poles"].axes) == 1


def test_the_command_takes_them(sensors_file, tmp_path, capsys):
    config, page = write_config(tmp_path), tmp_path / "page.html"
    status, text, _ = run(capsys, "report", config, sensors_file, "-o", page)
    assert (status, page.exists()) == (0, True)
    assert "Least residual" in text
    assert 'id="bode"' not in page.read_text()
