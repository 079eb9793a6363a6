"""The report of designs: its numbers are the library's, its files whole, its errors words."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.pages import Reader
from support.plants import LBT_YAML, lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design import Certificate, Check
from lbt_synth.report.designs.page import design_page
from lbt_synth.report.designs.report import frequency_errors, count_steps
from lbt_synth.report.designs.simulation import exact_spectrum, step_response
from lbt_synth.report.designs.verdict import good_range, verdict
from lbt_synth.report.number_text import fixed_text, listing_text, number_text, signed_text
from lbt_synth.report.provenance import creation_time
from lbt_synth.storage.tables import Table

SMALL = re.sub(
    r"errors_hz: .*",
    "errors_hz: [-3.5, -2, 2, 3.5]\n  sensor_gains: [0.3, 0.5, 1.0, 1.3]",
    LBT_YAML.read_text().replace("frames: 8000", "frames: 1000").replace("cases: 4", "cases: 2"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("report")
    (place / "small.yaml").write_text(SMALL)
    return place


@pytest.fixture(scope="module")
def config(folder):
    return lbt.load_config(folder / "small.yaml")


@pytest.fixture(scope="module")
def designs(config):
    slow = lbt.integrator(config.hardware, gain=0.4)
    fast = lbt.Controller(
        A=np.eye(2), B=1.5 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=1 / 800
    )
    return {
        "kalman": lbt.kalman(config.plant),
        "slow": slow,
        "wild": replace(slow, controller=fast, gain=1.5),  # unstable at gains above 2/3
    }


@pytest.fixture(scope="module")
def report(config, designs):
    return lbt.report.design_report(config, designs)


@pytest.fixture(scope="module")
def text(report, folder):
    lbt.report.write_report(report, folder / "a.html", pdf=folder / "a.pdf")
    return (folder / "a.html").read_text()


def test_the_numbers_are_those_of_the_library(report, config, designs):
    study = lbt.studies.limits(
        designs,
        config.hardware,
        config.truth,
        config.imaging,
        errors_hz=config.settings.robustness.errors_hz,
    )
    for (one, row), limits in zip(report.rows, study.rows, strict=True):
        assert row.residual_nm == pytest.approx(limits.residual_nm, rel=1e-9, nan_ok=True)
        assert row.above_limit_percent == pytest.approx(limits.above_limit_percent, nan_ok=True)
        if not one.stable:
            continue
        loop = lbt.close_loop(config.hardware, one.design.controller)
        budget = lbt.residual_budget(loop, config.truth)
        assert one.residual_nm == pytest.approx(budget.rms_nm, rel=1e-12)
        assert one.strehl == pytest.approx(lbt.strehl(budget, config.imaging), rel=1e-12)
        assert one.margins == lbt.loop_margins(loop)
        low, high = lbt.loop.stable_sensor_gains(config.hardware, one.design.controller)
        assert one.sensor_gains == (pytest.approx((low, high), rel=1e-9),)
        found = lbt.studies.robustness_map(
            one.design, config.truth, config.imaging, errors_hz=[-2.0, 0.0], sensor_gains=[0.5, 1.0]
        )
        at = [int(np.flatnonzero(one.map.errors_hz == e)[0]) for e in (-2.0, 0.0)]
        gains = [int(np.flatnonzero(one.map.sensor_gains == g)[0]) for g in (0.5, 1.0)]
        assert one.map.strehl[0][np.ix_(gains, at)] == pytest.approx(found.strehl[0], rel=1e-9)
        assert one.curve.strehl[0, 0, at] == pytest.approx(found.strehl[0, 1], rel=1e-9)
        peak = np.linalg.norm(loop.sensitivity(report.frequency_hz), 2, axis=(1, 2))
        assert one.rejection == pytest.approx(peak, rel=1e-9)
    kalman = report.assessments[0]
    assert (kalman.gamma, kalman.estimation_rms) == (kalman.design.gamma, kalman.design.rms)
    assert kalman.checks == designs["kalman"].recertify().checks


def test_an_unstable_loop_is_told_loudly(report, text):
    wild = report.assessments[2]
    assert not wild.stable
    assert wild.spectral_radius > 1
    assert wild.budget is None
    assert wild.margins is None
    assert "wild" not in report.simulations
    # an integrator of 1.5 in two frames is stable below 1 / 1.5
    (ends,) = wild.sensor_gains
    assert ends == pytest.approx((0.0, 2 / 3), abs=1e-6)
    assert not wild.certified  # its loop at the assumed gain, computed anew
    reader = Reader(text)
    notices = [a for a in reader.named("p") if "bad" in (a.get("class") or "")]
    assert len(notices) == 2
    assert "wild is UNSTABLE in the loop of this configuration" in text
    assert "The certificate of wild fails: spectral radius of the closed loop" in text
    assert "wild is UNSTABLE in this loop." in verdict(report)
    assert 'class="bad">UNSTABLE' in text
    assert text.count("wild: unstable") > 5


def test_simulations_agree_with_the_exact_answer(report):
    for one in report.stable:
        run_ = report.simulations[one.name]
        assert run_.residual_nm == pytest.approx(one.residual_nm, rel=0.15)
        inside = run_.frequency_hz > 5
        ratio = run_.residual_nm2_hz[inside] / run_.exact_nm2_hz[inside]
        assert np.mean(ratio) == pytest.approx(1, abs=0.06)
        assert run_.scatter > 0


def test_the_exact_spectrum_has_the_exact_power():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    design = lbt.integrator(path, gain=0.4)
    slow = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=10.0, frame_rate_hz=800)
    shake = lbt.Vibration(frequency_hz=60, damping=0.05, rms_nm=40, direction=(1,))
    line = lbt.models.SinusoidalVibration(frequency_hz=31.7, rms_nm=30.0, direction=(1,))
    truth = lbt.Truth(turbulence=slow, vibrations=(shake, line), noise_nm=5.0)
    loop = lbt.close_loop(path, design.controller)
    length = 2048
    grid = np.arange(length // 2 + 1) * 800 / length
    density = exact_spectrum(loop, truth, grid, length)
    power = np.sum(density[1:-1]) * 800 / length  # the ends hold half a bin
    assert np.sqrt(power) == pytest.approx(lbt.residual_budget(loop, truth).rms_nm, rel=2e-3)


def test_a_step_is_answered_frame_by_frame():
    path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller)
    time_s, residual, command = step_response(loop)
    assert time_s[:2] == pytest.approx([0, 0.002])
    # two frames pass before anything moves: y(1) sees the step, u(1) acts in frame 2
    expected, u = [100.0], [0.0]
    for k in range(1, 20):
        u.append(u[-1] + 0.5 * expected[k - 1])
        expected.append(100.0 - u[k - 1])
    assert residual[:20] == pytest.approx(expected)
    assert command[:20] == pytest.approx(u)


def test_the_verdict_is_made_of_the_numbers(report):
    words = verdict(report).replace("\u00a0", " ")
    kalman, slow, _ = report.assessments
    assert f"kalman leaves the least, {kalman.residual_nm:.1f} nm rms" in words
    assert f"Strehl ratio {100 * kalman.strehl:.1f} %" in words
    assert f"{100 * np.min(slow.curve.strehl):.1f} % for slow" in words
    found = good_range(kalman)
    strehls, errors = kalman.curve.strehl[0, 0], kalman.curve.errors_hz
    inside = (errors >= found.low_hz) & (errors <= found.high_hz)
    assert np.all(strehls[inside] >= 0.9 * strehls.max())
    outside = np.flatnonzero(np.diff(inside.astype(int)))
    for edge in outside:
        assert min(strehls[edge], strehls[edge + 1]) < 0.9 * strehls.max()
    assert f"kalman from {signed_text(found.low_hz)} to {signed_text(found.high_hz)} Hz" in words
    assert good_range(report.assessments[2]) is None
    assert "The certificate of wild does NOT hold." in words


def test_equals_are_told_as_equals(config, designs):
    kalman = designs["kalman"]
    pair = {"one": kalman, "two": kalman}
    words = verdict(lbt.report.design_report(config, pair)).replace("\u00a0", " ")
    assert "Of 2 stable designs, one and two leave the least, " in words
    assert ": they bear them alike." in words
    three = verdict(lbt.report.design_report(config, {"slow": designs["slow"], **pair}))
    assert "Of 3 stable designs, one and two leave the least, " in three
    assert ": one and two bear them best." in three or ": slow bears them best." in three


def test_a_limit_of_nothing_is_no_limit(config, designs):
    still = lbt.Truth(turbulence=None, noise_nm=config.truth.noise_nm)
    report = lbt.report.design_report(replace(config, truth=still), {"slow": designs["slow"]})
    assert report.limits.limit.rms_nm == 0
    assert "above the limit" not in words_of(report)
    assert "passed, 1 check " in words_of(report) + " "


def test_the_page_has_all_that_it_should(text, report, config):
    reader = Reader(text)
    titles = " ".join(reader.texts["h2"] + reader.texts["h3"])
    for word in (
        "Summary",
        "Rejection and noise",
        "Strehl ratio over the frequency error",
        "Poles",
        "Answer to a step",
        "Certificates",
        "Configuration and versions",
    ):
        assert word in titles
    for heading in (
        "method",
        "Strehl ratio, exact [%]",
        "modulus margin",
        "states of the controller",
        "stable real sensor gains",
        "certificate, computed anew",
    ):
        assert heading in reader.texts["th"]
    kalman = report.assessments[0]
    cells = reader.texts["td"]
    assert fixed_text(kalman.residual_nm, 1) in cells
    assert fixed_text(100 * kalman.strehl, 2) in cells
    assert hashlib.sha256(config.source.read_bytes()).hexdigest() in cells
    assert lbt.__version__ in cells
    assert "# The adaptive optics of the Large Binocular Telescope" in reader.texts["code"][0]
    assert reader.texts["code"][0] == SMALL
    assert len(text) < 5e6
    for figure in reader.named("figure"):
        assert figure["id"] in {a["href"][1:] for a in reader.named("a")}


def test_the_pdf(folder, text):
    pdf = (folder / "a.pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert 8 <= len(re.findall(rb"/Type /Page\b", pdf)) <= 14
    assert b"/Author (lbt_synth" in pdf
    assert b"/Title (Controllers for small.yaml)" in pdf


def words_of(report):
    """All texts of the page of a report but those of its charts."""
    blocks = [block for section in design_page(report).sections for block in section.blocks]
    texts = [block.text for block in blocks if hasattr(block, "text")]
    tables = [block for block in blocks if isinstance(block, Table)]
    return " ".join(texts + [c.text for table in tables for row in table.cells() for c in row])


def test_a_truth_without_vibrations(config, designs):
    calm = replace(config, truth=replace(config.truth, vibrations=()))
    report = lbt.report.design_report(calm, {"slow": designs["slow"]})
    assert report.errors_hz.tolist() == [0.0]
    page = design_page(report, title="calm")
    assert "sensor-gain" in [chart.key for chart in page.charts]
    assert page.title == "calm"
    assert "no vibration" in words_of(report)
    assert "slow leaves" in verdict(report)


def test_errors_that_would_leave_the_band_are_left_out(config):
    line = lbt.models.SinusoidalVibration(frequency_hz=2.0, rms_nm=10)
    low = replace(config, truth=replace(config.truth, vibrations=(line,)))
    errors = frequency_errors(low)
    assert errors[0] == -3.5
    assert errors[-1] < 2.0
    assert np.all(np.diff(errors) > 0)
    assert frequency_errors(config)[[0, -1]].tolist() == [-3.5, 3.5]


def test_many_designs_fill_several_sheets(config):
    many = {f"design {i}": lbt.integrator(config.hardware, gain=0.2 + 0.02 * i) for i in range(8)}
    report = lbt.report.design_report(config, many)
    keys = [chart.key for chart in design_page(report).charts]
    assert {"map", "map-2", "poles-2", "spectra-2", "series-2"} <= set(keys)
    (section,) = [s for s in design_page(report).sections if s.key == "summary"]
    (table,) = [block for block in section.blocks if isinstance(block, Table)]
    assert len(table.headings) == 9


def test_nothing_stable_is_needed(config, designs):
    report = lbt.report.design_report(config, {"wild": designs["wild"]})
    text = words_of(report)
    charts = design_page(report).charts
    assert [chart.key for chart in charts] == ["map", "poles"]  # none of them is empty
    honest = replace(report.assessments[0], checks=())
    assert "passed; they are about the loops that the designs were made for" in verdict(
        replace(report, assessments=(honest,))
    )
    assert "No loop is stable, so none was simulated." in text
    assert "No loop is stable, so none has a rejection" in text
    assert "Of 0" not in text


def test_a_certificate_that_cannot_be_computed(config, monkeypatch):
    slow = lbt.integrator(config.hardware, gain=0.4)

    def broken(self):
        raise lbt.errors.NumericalError("the norm did not settle.")

    monkeypatch.setattr(type(slow), "recertified", broken)
    report = lbt.report.design_report(config, {"slow": slow})
    assert not report.assessments[0].certified
    text = words_of(report)
    assert "The certificate of slow fails: the norm did not settle." in text
    assert "slow: not computed: the norm did not settle." in text
    assert "NOT COMPUTED" in text


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


def test_numbers_as_texts():
    assert [
        number_text(v) for v in (0.0, 27.701, 1234.56, 123456.0, 1e-9, -2.5, np.inf, np.nan)
    ] == [
        "0",
        "27.7",
        "1235",
        "123456",
        "1e\u22129",
        "\u22122.5",
        "∞",
        "\u2013",
    ]
    assert fixed_text(-0.001, 1) == "0.0"
    assert fixed_text(float("nan"), 1) == "\u2013"
    assert fixed_text(float("-inf"), 1) == "\u2212∞"
    assert signed_text(0.5) == "+0.5"
    assert signed_text(0.0) == "0"
    assert listing_text([]) == ""
    assert listing_text(["a", "b", "c"]) == "a, b and c"


def test_the_time_of_making(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert creation_time() == datetime(1970, 1, 2, tzinfo=UTC)
    for wrong in ("tomorrow", "1e400", str(10**30)):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", wrong)
        with pytest.raises(lbt.errors.ProblemError, match="SOURCE_DATE_EPOCH must be a number"):
            creation_time()
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    assert abs((datetime.now(UTC) - creation_time()).total_seconds()) < 60


def test_what_is_counted(config, designs):
    done = []
    lbt.report.design_report(config, designs, advance=done.append)
    assert sum(done) == count_steps(3) - 1  # the unstable one is not simulated


# ---------------------------------------------------------------------------------------------
# At the terminal
# ---------------------------------------------------------------------------------------------


def test_command(folder, designs, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    for name in ("kalman", "slow"):
        lbt.save_gain(f"{name}.fits", designs[name])
    command = ("report", "small.yaml", "kalman.fits", "slow.fits")
    status, out, error = run(capsys, *command, "-o", "r.html", "--pdf", "r.pdf", "--json")
    assert (status, error) == (0, "")
    data = json.loads(out)
    assert data["files"] == ["r.html", "r.pdf"]
    assert list(data["designs"]) == ["kalman", "slow"]
    kalman = data["designs"]["kalman"]
    loop = lbt.close_loop(lbt.load_config("small.yaml").hardware, designs["kalman"].controller)
    budget = lbt.residual_budget(loop, lbt.load_config("small.yaml").truth)
    assert kalman["residual_nm"] == pytest.approx(budget.rms_nm)
    assert kalman["certified"] is True
    assert (
        data["sha256"]["kalman.fits"]
        == hashlib.sha256(Path("kalman.fits").read_bytes()).hexdigest()
    )
    assert data["made"] == "2023-11-14 22:13:20 UTC"
    first = [Path(name).read_bytes() for name in ("r.html", "r.pdf")]
    status, out, _ = run(capsys, *command, "-o", "r.html")
    assert status == 0
    assert "kalman leaves the least" in out
    assert "written: r.html" in out
    assert [Path(name).read_bytes() for name in ("r.html", "r.pdf")] == first


def test_hostile_files_are_quoted(folder, designs, tmp_path, capsys):
    name = "<script>alert('x')<" + "_k.fits"
    lbt.save_gain(tmp_path / name, designs["slow"])
    yaml = tmp_path / "a&b.yaml"
    yaml.write_text("# </code></pre><script>alert(2)</script>\n" + SMALL)
    out_file = tmp_path / "r.html"
    status, _, error = run(
        capsys,
        "report",
        str(yaml),
        str(tmp_path / name),
        "-o",
        str(out_file),
        "--title",
        "<i>T</i>",
    )
    assert (status, error) == (0, "")
    text = out_file.read_text()
    reader = Reader(text)
    assert len(reader.named("script")) == 3
    assert not reader.named("i")
    assert reader.texts["title"] == ["<i>T</i>"]
    assert reader.texts["code"][0].startswith("# </code></pre><script>alert(2)</script>")
    assert "<script>alert('x')<_k" in reader.texts["th"]


def test_pages_name_no_directories(folder, designs, tmp_path, capsys):
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        lbt.save_gain(tmp_path / place / "k.fits", designs["slow"])
    files = [str(tmp_path / place / "k.fits") for place in ("a", "b")]
    status, out, _ = run(
        capsys, "report", str(folder / "small.yaml"), *files, "-o", str(tmp_path / "r.html")
    )
    assert status == 0
    assert "a/k.fits and b/k.fits leave the least" in out
    text = (tmp_path / "r.html").read_text()
    assert "a/k.fits" in text
    assert str(tmp_path) not in text


@pytest.mark.parametrize("name", ["red\x1b[31m", "two\nlines", "bad\udcff", "turned\u202e"])
def test_names_that_no_page_can_show_are_refused(folder, designs, report, tmp_path, capsys, name):
    with pytest.raises(lbt.errors.ProblemError, match="name of a design must be of letters"):
        lbt.report.design_report(report.config, {name: designs["slow"]})
    with pytest.raises(lbt.errors.ProblemError, match="title must be of letters"):
        lbt.report.write_report(report, tmp_path / "r.html", title=name)
    lbt.save_gain(tmp_path / "k.fits", designs["slow"])
    odd = (tmp_path / "k.fits").rename(tmp_path / f"{name}.fits")
    status, out, error = run(
        capsys, "report", str(folder / "small.yaml"), str(odd), "-o", str(tmp_path / "r.html")
    )
    assert (status, out) == (2, "")
    assert "must be of letters that a page can show" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "r.html").exists()


@pytest.mark.parametrize("wrong", ["tomorrow", "", str(10**30)])
def test_a_wrong_time_is_refused_before_libraries_read_it(wrong):
    # numpy and scipy read it when they are loaded: only a new process shows that
    done = subprocess.run(
        [sys.executable, "-m", "lbt_synth.cli.main", "report", "a.yaml", "k.fits", "-o", "x.html"],
        env=os.environ | {"SOURCE_DATE_EPOCH": wrong},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "SOURCE_DATE_EPOCH must be a number of seconds" in done.stderr


@pytest.fixture(scope="module")
def gains(folder, designs, config):
    lbt.save_gain(folder / "ok.fits", designs["slow"])
    lbt.save_gain(folder / "one_axis.fits", lbt.kalman(lbt_axis_plant(modes=1)))
    other = replace(config.hardware, frame_rate_hz=1000.0)
    lbt.save_gain(folder / "fast.fits", lbt.integrator(other, gain=0.4))
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    lbt.save_gain(folder / "bare.fits", lbt.kalman(walk))
    drift = SMALL.replace(
        "{kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}",
        "{kind: drift, axis: tip, frequency_hz: 20.0, end_hz: 21.0, duration_s: 5.0, rms_mas: 80.0}",
    )
    (folder / "drift.yaml").write_text(drift)
    return folder


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            ("small.yaml", "one_axis.fits", "-o", "x.html"),
            "one_axis must be for the configuration's 2",
        ),
        (("small.yaml", "fast.fits", "-o", "x.html"), "800 Hz; got a design for 1000 Hz"),
        (("small.yaml", "bare.fits", "-o", "x.html"), "bare estimation problem"),
        (("small.yaml", "none.fits", "-o", "x.html"), "cannot read none.fits"),
        (("none.yaml", "ok.fits", "-o", "x.html"), "cannot read none.yaml"),
        (("small.yaml", "ok.fits", "ok.fits", "-o", "x.html"), "given once"),
        (("small.yaml", "ok.fits", "-o", "x.pdf"), "a page must end in .html; got 'x.pdf'"),
        (("small.yaml", "ok.fits", "-o", "x.html", "--pdf", "x.ps"), "a page must end in .pdf"),
        (("small.yaml", "ok.fits", "-o", "no/x.html"), "no directory no"),
        (("small.yaml", "ok.fits", "-o", "x.html", "--pdf", "no/x.pdf"), "no directory no"),
        (("small.yaml", "ok.fits", "-o", "x.html", "--title", " "), "--title must hold"),
        (("drift.yaml", "ok.fits", "-o", "x.html"), "a truth that is stationary"),
    ],
)
def test_bad_input_ends_in_one_line(gains, capsys, monkeypatch, arguments, text):
    monkeypatch.chdir(gains)
    status, out, error = run(capsys, "report", *arguments)
    assert (status, out) == (2, "")
    assert text in error
    assert error.count("\n") == 1
    assert not Path("x.html").exists()


def test_both_files_or_none(report, tmp_path, monkeypatch):
    (tmp_path / "a.html").write_text("old")
    monkeypatch.setattr("lbt_synth.report.page.page_files.page_html", lambda page: b"new")
    monkeypatch.setattr("lbt_synth.report.page.page_files.page_pdf", lambda page: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        lbt.report.write_report(report, tmp_path / "a.html", pdf=tmp_path / "a.pdf")
    assert (tmp_path / "a.html").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]


def test_refused_in_the_library(report, config, designs, tmp_path):
    with pytest.raises(lbt.errors.ProblemError, match="needs 1 to 36 designs; got 0"):
        lbt.report.design_report(config, {})
    with pytest.raises(lbt.errors.ProblemError, match="title must hold"):
        lbt.report.write_report(report, tmp_path / "a.html", title=" ")
    with pytest.raises(lbt.errors.OutputError, match="must end in .html"):
        lbt.report.write_report(report, tmp_path / "a.txt")
    with pytest.raises(lbt.errors.FileError, match="cannot read"):
        lbt.report.design_report(config, designs, gain_files={"kalman": tmp_path / "none.fits"})
    with pytest.raises(lbt.errors.ProblemError, match="expected a Config"):
        lbt.report.design_report("lbt.yaml", designs)
    gone = tmp_path / "gone.yaml"
    shutil.copy(config.source, gone)
    loaded = lbt.load_config(gone)
    gone.unlink()
    with pytest.raises(lbt.errors.FileError, match="cannot read"):
        lbt.report.design_report(loaded, designs)
