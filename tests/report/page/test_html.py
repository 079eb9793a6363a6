"""Pages as one HTML file: whole, with words for every figure, and safe from hostile names."""

import base64
import hashlib
import re
import sys
from itertools import pairwise

import numpy as np
import pytest
from support.browser import DESK, PHONE, opened
from support.pages import HOSTILE, Reader, every_mark, whole_page

import lbt_synth as lbt
from lbt_synth.report.draw import drawing, name_axes
from lbt_synth.report.page.html import (
    chart_svg,
    creation_time,
    new_page,
    number_tables,
    page_html,
    print_html,
    require_page_names,
    unbroken_text,
    write_page,
)


@pytest.fixture(scope="module")
def plain():
    return page_html(whole_page()).decode()


@pytest.fixture(scope="module")
def hostile():
    return page_html(whole_page(HOSTILE)).decode()


def test_a_page_is_well_formed_and_whole(plain):
    reader = Reader(plain)
    assert plain.startswith("<!DOCTYPE html>")
    assert reader.named("html") == [{"lang": "en"}]
    assert len(reader.named("h1")) == len(reader.named("title")) == len(reader.named("main")) == 1
    levels = [int(tag[1]) for tag, _ in reader.elements if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    ids = [a["id"] for _, a in reader.elements if "id" in a]
    assert len(ids) == len(set(ids)) > 50
    for _, attributes in reader.elements:  # every reference has its element
        for name in ("aria-labelledby", "aria-describedby"):
            assert attributes.get(name, ids[0]) in ids
        target = attributes.get("href") or attributes.get("xlink:href") or f"#{ids[0]}"
        assert target[1:] in ids or target.startswith("data:image/png;base64,")
        for place in re.findall(r"url\(#(.*?)\)", attributes.get("clip-path") or ""):
            assert place in ids
    assert reader.named("a")[0]["href"] == "#_content"


def test_tables_have_captions_and_scopes(plain):
    reader = Reader(re.sub("<details>.*?</details>", "", plain, flags=re.DOTALL))
    assert len(reader.named("table")) == len(reader.named("caption")) == 3  # the wide one is two
    assert {a.get("scope") for a in reader.named("th")} == {"col", "row", "rowgroup"}
    assert "Wide (continued)" in plain


def test_figures_have_words_and_numbers(plain):
    reader = Reader(plain)
    charts = every_mark()
    assert len(reader.named("figure")) == len(reader.named("figcaption")) == len(charts)
    drawings = [a for a in reader.named("svg") if a.get("role") == "img"]
    assert [a["aria-label"] for a in drawings] == [chart.alt for chart in charts]
    for chart in charts:
        assert plain.count(chart.caption) >= 1
        (tables,) = re.findall(f'id="{chart.key}".*?<details>(.*?)</details>', plain, re.DOTALL)
        assert "nan" not in tables
        for table in number_tables(chart.figure):
            for part in table.by_columns(6):
                assert f">{part.caption or 'Numbers'}</caption>" in tables
    assert reader.texts["summary"] == ["Numbers"] * len(charts)


def test_numbers_of_long_curves_keep_their_peaks():
    x = np.linspace(0, 1, 5001)
    peak = 1 / (1e-6 + (x - 0.4321) ** 2)
    with drawing([2.0]) as (panel,):
        name_axes(panel, ("x", ""), ("y", "nm"))
        panel.plot(x, peak, label="peak")
        panel.plot(x, np.where(x > 0.5, np.nan, -peak), label="hole")
    (table,) = number_tables(panel.figure)
    assert table.headings == ("x", "peak", "hole")
    assert 60 < len(table.rows) <= 120
    assert table.rows[0][0] == "0"
    assert table.rows[-1] == ("1", table.rows[-1][1], "-")
    shown = [float(row[1]) for row in table.rows]
    assert max(shown) == pytest.approx(peak.max(), rel=1e-4)


def test_a_number_and_its_error_stay_in_one_line():
    assert unbroken_text("1 ± 2 (3 to 4)") == "1\u00a0±\u00a02 (3\u00a0to\u00a04)"
    assert unbroken_text("-1 +- 2") == "\u22121\u00a0±\u00a02"
    assert unbroken_text("-3.1e-08, 1e-6, a-b") == "\u22123.1e\u221208, 1e\u22126, a-b"
    assert unbroken_text("-inf, tomorrow is not together") == "\u2212∞, tomorrow is not together"


def test_drawings_keep_their_text():
    strange = "$\\frac{$ 文字"  # no mathematics, and no such glyph
    svg = chart_svg(every_mark(strange)[0])
    texts = re.findall(r"<text[^>]*>(.*?)</text>", svg)
    assert {"frequency [Hz]", "steps [nm]", "only named", strange} <= set(texts)
    assert 'viewBox="0 0' in svg
    assert " width=" not in svg.split(">")[0]


def test_nothing_is_fetched(plain):
    reader = Reader(plain)
    assert {"link", "img", "iframe", "script"}.isdisjoint(tag for tag, _ in reader.elements)
    (policy,) = [a for a in reader.named("meta") if "http-equiv" in a]
    assert "default-src 'none'" in policy["content"]
    assert "http" not in policy["content"]
    assert "@import" not in plain
    for image in reader.named("image"):
        assert image["xlink:href"].startswith("data:image/png;base64,")


def test_hostile_names_stay_names(hostile, plain):
    reader, usual = Reader(hostile), Reader(plain)
    assert {tag for tag, _ in reader.elements} == {tag for tag, _ in usual.elements}
    assert not reader.named("script")
    assert reader.texts["title"][0] == f"Page of {HOSTILE}"
    assert HOSTILE in reader.texts["th"]  # of a table of numbers


def contrast(*shades):
    """Contrast ratio of WCAG 2.2 of two texts "#rrggbb"."""
    parts = np.array([[int(shade[i : i + 2], 16) / 255 for i in (1, 3, 5)] for shade in shades])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    dark, light = np.sort(linear @ [0.2126, 0.7152, 0.0722])
    return (light + 0.05) / (dark + 0.05)


def test_contrast_of_texts(plain):
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    named = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", plain))
    pairs = [(ink, "paper") for ink in ("ink", "soft", "link", "good", "note", "bad")]
    pairs += [("ink", f"{kind}tint") for kind in ("", "note-", "good-")] + [("bad", "bad-tint")]
    for ink, paper in pairs:
        assert contrast(named[ink], named[paper]) >= 4.5, (ink, paper)


@pytest.mark.browser
@pytest.mark.parametrize("name", ["report", "study", "marks", "hostile"])
def test_it_opens_offline_without_a_word(browser, pages, name):
    opened(browser, pages[name])
    said = [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"]
    assert said == []
    asked = [
        found
        for entry in browser.get_log("performance")
        if '"Network.requestWillBeSent"' in entry["message"]
        for found in re.findall(r'"url":"([^"]*)"', entry["message"])
    ]
    outside = {url for url in asked if not url.startswith(("data:", "blob:"))}
    assert {url.split("#")[0] for url in outside} <= {pages[name]}
    assert browser.execute_script("return document.scripts.length") == 0


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
def test_it_fits_a_phone(browser, pages, name):
    opened(browser, pages[name], PHONE)
    widths = browser.execute_script(
        "return [document.documentElement.scrollWidth, document.body.scrollWidth, innerWidth]"
    )
    assert max(widths) <= 360
    assert beyond_the_edge(browser, ".scroll, pre, .skip, .drawing, details") == []
    small = browser.execute_script(
        """
        return [...document.querySelectorAll("p, td, th, a, figcaption, button, pre")]
          .filter(e => e.offsetHeight && parseFloat(getComputedStyle(e).fontSize) < 12).length
        """
    )
    assert small == 0


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


def test_without_the_extra_a_pdf_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    said = r'a page as PDF needs WeasyPrint and Pango: pip install "lbt-synth\[pdf\]"'
    with pytest.raises(lbt.errors.MissingExtraError, match=said) as caught:
        require_page_names(tmp_path / "a.html", tmp_path / "a.pdf")
    assert caught.value.extra == "pdf"
    require_page_names(tmp_path / "a.html")


@pytest.mark.e2e
def test_a_pdf_has_sheets_of_a4_and_no_date(tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")  # fonts have one
    files = write_page(whole_page(), tmp_path / "a.html", pdf=tmp_path / "a.pdf")
    assert [path.name for path in files] == ["a.html", "a.pdf"]
    pdf = files[1].read_bytes()
    assert pdf.startswith(b"%PDF")
    assert b"CreationDate" not in pdf
    for box in re.findall(rb"/MediaBox\s*\[(.*?)\]", pdf):
        assert [float(x) for x in box.split()] == pytest.approx([0, 0, 595.28, 841.89], abs=0.1)
    assert print_html(files[0].read_bytes()) == pdf
    assert print_html(page_html(whole_page(HOSTILE))).startswith(b"%PDF")


def test_a_page_says_what_it_was_made_from_and_leaves_out_what_is_empty(tmp_path):
    config, gain = tmp_path / "a.yaml", tmp_path / "b.fits"
    config.write_text("a: 1\n")
    gain.write_bytes(b"b")
    sources = [(config, "configuration"), (gain, "gain file")]
    page = new_page("t", "one design", {"Empty": (), "Words": ("words",)}, sources=sources)
    assert list(page.sections) == ["Words", "Files and versions"]
    files, _, listing = page.sections["Files and versions"]
    assert page.digests == {row[0]: row[2] for row in files.rows}
    assert page.digests["b.fits"] == hashlib.sha256(b"b").hexdigest()
    assert listing == ("Configuration a.yaml", "a: 1\n")
    assert page.subtitle == f"one design. Made {page.made}."


def test_a_name_that_is_no_text_is_shown_with_an_escape():
    page = new_page("bad\udcff", "", {})
    assert b"bad\\udcff" in page_html(page)


def test_the_creation_time(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert creation_time() == "1970-01-02 00:00:00 UTC"
    for wrong in ("tomorrow", "1e400", str(10**30)):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", wrong)
        with pytest.raises(lbt.errors.ProblemError, match="SOURCE_DATE_EPOCH must be a number"):
            creation_time()
