"""The pages of a study and of a diagnosis, and all pages as a browser shows them."""

import base64
import hashlib
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.browser import DESK, PHONE, chromium, opened
from support.diagnoses import line_diagnosis, short_record
from support.pages import HOSTILE, Reader, whole_page
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.report.page.html import Chart, Notice, page_html, write_page
from lbt_synth.report.pages import binned_map, cumulative_points, diagnosis_page, study_page
from lbt_synth.storage.tables import Table
from lbt_synth.studies.study.run import evaluate_samples
from lbt_synth.studies.study.statistics import study_statistics

PARAMETERS = ("truth.sensor_gain", "error.delay_frames", "atmosphere.wind_speed_m_s", "fixed")
CONTROLLERS = ("steady", "sharp", "frail")
FAILURES = [(row, "frail", f"<b>no</b> design in row {row}") for row in range(0, 300, 20)]


def results(n=300):
    """Three controllers: one steady, one that low gains make unstable, one that fails at times."""
    rng = np.random.default_rng(0)
    gain, delay = 0.4 + 0.7 * rng.random(n), 0.3 * rng.random(n)
    wind = rng.choice([10.0, 20.0, 30.0], n)
    columns = dict(zip(PARAMETERS, (gain, delay, wind, np.full(n, 0.9)), strict=True))
    steady, sharp = 0.8 - 0.1 * delay - 0.002 * wind, 0.9 * gain / 1.1 - 0.5 * delay
    failed = np.where(np.arange(n) % 50 == 0, np.nan, 1.0)
    for name, strehl, stable in (
        ("steady", steady, np.ones(n)),
        ("sharp", sharp, np.where(gain < 0.5, 0.0, 1.0)),
        ("frail", 0.7 - 0.2 * gain, failed),
    ):
        seen = np.where(stable == 1, strehl, np.nan)
        values = {"stable": stable, "strehl": seen, "residual_nm": 100 * (1 - seen)}
        columns |= {f"{name}.{quantity}": column for quantity, column in values.items()}
    return columns


@cache
def example_study(**changes):
    """The study of the examples with other settings; with changes it is read from night.yaml."""
    study = lbt.studies.load_study(ROOT / "examples" / "study.yaml")
    settings = study.settings.model_copy(update=changes)
    return replace(study, settings=settings, source=Path("night.yaml")) if changes else study


def page_of(columns, controllers=CONTROLLERS, parameters=PARAMETERS, study=None):
    columns = {"row": np.arange(len(columns[f"{controllers[0]}.stable"]))} | columns
    statistics = study_statistics(columns, parameters, controllers)
    more = {"folder": "out", "failures": FAILURES, "computing_s": 75.0}
    return study_page(study or example_study(samples=300), columns, statistics, **more)


@pytest.fixture(scope="module")
def page():
    return page_of(results())


def table(page, start):
    return next(b for b in page.blocks if isinstance(b, Table) and b.caption.startswith(start))


def test_what_is_wrong_is_said_first(page):
    failed, unstable, words = page.blocks[:3]
    percent = np.sum(results()["sharp.stable"] == 0) / 3
    assert unstable.text == f"sharp is unstable in {percent:.2f} % of the samples."
    assert "frail 6" in failed.text
    assert (failed.tone, unstable.tone) == ("bad", "bad")
    steady = 100 * results()["steady.strehl"]
    assert f"Strehl ratios: highest mean, steady {steady.mean():.1f} %" in words
    low = f"highest 5th percentile, steady {np.percentile(steady, 5):.1f} %."
    assert f"{low} That of steady depends most on" in words
    first = page_of({name: values[:100] for name, values in results().items()}).blocks[0]
    assert (first.tone, "100 of 300 samples" in first.text) == ("bad", True)


def test_failures_are_counted_and_the_worst_rows_have_the_command_that_replays_them(page):
    failures = table(page, "Evaluations that failed")
    assert (len(failures.rows), failures.rows[1]) == (10, ("20", *FAILURES[1][1:]))
    assert failures.caption.endswith("the first 10, and 5 more")
    worst = [[cell.text for cell in row] for row in table(page, "Worst samples of sharp").cells()]
    assert {status for _, status, *_ in worst} == {"unstable"}
    moved = page_of(
        results(), study=replace(example_study(samples=300), source=Path("my {b}.yaml"))
    )
    for replayed, file in ((page, "night.yaml"), (moved, "'my {b}.yaml'")):
        (commands,) = (b[1] for b in replayed.blocks if isinstance(b, tuple) and "replay" in b[0])
        assert commands.splitlines()[1] == f"lbt-synth study {file} -o out --row {worst[0][0]}"


@pytest.mark.parametrize("n", [1, 21])
def test_few_samples_make_a_page_all_the_same(n):
    columns = {name: values[:n] for name, values in results().items()}
    assert b"nan" not in page_html(page_of(columns))


def test_nothing_evaluated_makes_a_page_without_figures():
    lost = {
        name: np.nan * x if name.startswith(CONTROLLERS) else x for name, x in results(30).items()
    }
    page = page_of(lost)
    assert page.sections["Summary"][-3] == "No controller was evaluated on any sample."
    assert page.charts == []


def test_a_page_from_a_study_file(tmp_path):
    study = example_study()
    values, names = study.values(0, 3), study.parameter_names
    columns = dict(zip(names, values.T, strict=True)) | {"row": np.arange(3)}
    columns |= evaluate_samples(study, values, 0)[0]
    statistics = study_statistics(columns, names, list(study.controllers))
    page = lbt.report.study_page(study, columns, statistics, folder=tmp_path / "a folder")
    sections = {  # without its drawings, which are slow to make
        title: [block for block in blocks if not isinstance(block, Chart)]
        for title, blocks in page.sections.items()
    }
    html = page_html(replace(page, sections=sections)).decode()
    for words in (
        "3 of 4096 samples",
        "normal, 20 with deviation 0.5, from 18, to 22",
        "hinf (gamma_ratio 1.2) for the configuration",
        study.digest,
        "samples: 4096",
        "diameter_m: 8.22",
        "a folder&#39; --row 0",
    ):
        assert words in html, words


def test_each_design_says_which_errors_it_survives():
    study = example_study()
    fast = lbt.integrator(study.config.hardware, gain=0.9)  # unstable above 1
    designs = {**study.controllers, "fast": fast}
    names = [f"{name}.{x}" for name in designs for x in ("strehl", "stable", "residual_nm")]
    columns = dict.fromkeys((*names, "fixed"), np.ones(2))
    page = page_of(columns, (*designs,), ("fixed",), replace(study, controllers=designs))
    blocks = page.sections["Summary"]
    notices = [block.text for block in blocks if isinstance(block, Notice)]
    for name, design in designs.items():
        margins = lbt.loop_margins(lbt.close_loop(design.hardware, design))
        assert f"{name} {margins.survival}" in blocks
        warnings = [f"{name}: {words}" for words in margins.fragilities]
        assert [words for words in notices if words.startswith(name)] == warnings
    assert "fast: a sensor gain that is off by 0.92 dB makes this loop unstable." in notices


def test_the_size_does_not_grow_with_the_samples():
    small, large = (len(page_html(page_of(results(n)))) for n in (4000, 20_000))
    assert small < large < 1.4 * small
    assert large < 1.5e6


@pytest.mark.parametrize("n", [1, 400, 401, 50_000])
def test_points_of_a_distribution_lie_on_it(n):
    values = np.round(np.random.default_rng(n).normal(size=n), 2)
    level, share = cumulative_points(values)
    assert len(level) <= 500
    assert np.all(np.diff(level) > 0)
    np.testing.assert_allclose(share, [np.mean(values <= bound) for bound in level])
    assert (level[0], share[-1]) == (values.min(), 1)


def test_a_map_has_the_mean_of_each_cell():
    x, y = np.random.default_rng(1).random((2, 4000))
    columns, rows, mean = binned_map(x, y, x * y)
    assert mean.shape == (rows.size, columns.size) == (22, 22)
    np.testing.assert_allclose(mean, np.outer(rows, columns), atol=0.02)
    assert np.isnan(binned_map(*[np.arange(9.0)] * 3)[2]).any()  # a cell without samples


def test_the_page_of_a_diagnosis(tmp_path):
    source = tmp_path / "night.npz"
    source.write_bytes(b"what was recorded")
    page = diagnosis_page(line_diagnosis(), [source])
    (spectra,) = page.charts
    assert (spectra.key, len(spectra.figure.axes)) == ("identification", 3)
    names = [row.name for row in line_diagnosis().residuals]
    assert [row[0] for row in table(page, "Residual on").rows] == names
    (path,) = write_page(page, tmp_path / "page.html")
    reader = Reader(path.read_text(encoding="utf-8"))
    assert "± [nm]" in reader.texts["th"]
    assert reader.texts["h1"] == ["Diagnosis of night.npz"]
    assert hashlib.sha256(b"what was recorded").hexdigest() in reader.texts["td"]
    notices = [a["class"] for a in reader.named("p") if "notice" in (a.get("class") or "")]
    assert "notice good" in notices
    assert "notice bad" not in notices


def test_a_diagnosis_of_wrong_commands_is_loud():
    page = diagnosis_page(lbt.identification.diagnose(short_record(-1.0)))
    words = "The commands are not those that the mirror followed: they have the opposite sign."
    assert page.blocks[0] == Notice(text=words, tone="bad")
    assert page.charts == []


@pytest.fixture(scope="module")
def pages(small_config, small_designs, page, tmp_path_factory):
    """Addresses of a real report, a study, and a page with every kind of mark and hostile names."""
    folder, (kalman, slow, _) = tmp_path_factory.mktemp("browser"), small_designs.values()
    designs = {"kalman": kalman, "integrator with a rather long name of its file": slow}
    pages = {
        "report": lbt.report.design_page(small_config, designs),
        "study": page,
        "marks": whole_page(),
        "hostile": whole_page(HOSTILE),
    }
    return {
        name: write_page(page, folder / f"{name}.html")[0].as_uri() for name, page in pages.items()
    }


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    pytest.importorskip("selenium")
    driver = chromium(tmp_path_factory.mktemp("profile"))
    driver.execute_cdp_cmd("Network.enable", {})
    driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": ["http://*", "https://*", "ws://*"]})
    offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
    driver.execute_cdp_cmd("Network.emulateNetworkConditions", offline)
    yield driver
    driver.quit()


def beyond_the_edge(browser, without):
    """Elements of the page, but for some, that reach out of the window."""
    script = """
        return [...document.body.querySelectorAll("*")]
          .filter(e => !e.closest(arguments[0]) && e.getBoundingClientRect().width)
          .map(e => [e.tagName, e.className.toString(), e.getBoundingClientRect()])
          .filter(([, , box]) => box.right > innerWidth + 1 || box.left < -1);
    """
    return browser.execute_script(script, without)


@pytest.mark.browser
@pytest.mark.parametrize("name", ["report", "study", "marks", "hostile"])
def test_it_opens_offline_without_a_word_and_fits_a_phone(browser, pages, name):
    opened(browser, pages[name], PHONE)
    assert [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"] == []
    asked = [
        url
        for entry in browser.get_log("performance")
        if '"Network.requestWillBeSent"' in entry["message"]
        for url in re.findall(r'"url":"([^"]*)"', entry["message"])
    ]
    outside = {url.split("#")[0] for url in asked if not url.startswith(("data:", "blob:"))}
    assert outside <= {pages[name]}
    scripts, small, *widths = browser.execute_script(
        """
        const texts = [...document.querySelectorAll("p, td, th, a, figcaption, button, pre")]
          .filter(e => e.offsetHeight && parseFloat(getComputedStyle(e).fontSize) < 12);
        return [document.scripts.length, texts.length, document.documentElement.scrollWidth,
                document.body.scrollWidth, innerWidth];
        """
    )
    assert (scripts, small) == (0, 0)
    assert max(widths) <= 360
    assert beyond_the_edge(browser, ".scroll, pre, .skip, .drawing, details") == []


@pytest.mark.browser
@pytest.mark.parametrize("name", ["report", "study", "marks", "hostile"])
def test_it_fits_a_sheet_of_paper(browser, pages, name):
    opened(browser, pages[name])
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    inside = {**DESK, "width": 688, "height": 1009}  # A4 less the margins, at 96 pixels an inch
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", inside)
    assert beyond_the_edge(browser, ".skip, defs") == []
    heights, hidden, width = browser.execute_script(
        """
        return [[...document.querySelectorAll(".drawing svg")].map(e => e.clientHeight),
                [...document.querySelectorAll("details")].every(e => e.offsetHeight === 0),
                document.documentElement.scrollWidth];
        """
    )
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert 200 < min(heights) <= max(heights) < 1009
    assert hidden
    assert width <= 688
    options = {"preferCSSPageSize": True, "printBackground": True}
    pdf = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", options)["data"])
    sheets = len(re.findall(rb"/Type\s*/Page\b", pdf))
    assert (7 if name == "report" else 3) <= sheets <= 15
    boxes = {tuple(map(float, box.split())) for box in re.findall(rb"/MediaBox\s*\[(.*?)\]", pdf)}
    assert all(box[2:] == pytest.approx((595, 842), abs=1) for box in boxes)
