"""Pages as one HTML file: whole, with words for every figure, and safe from hostile names."""

import hashlib
import re
import sys
from itertools import pairwise

import numpy as np
import pytest
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
def reader(plain):
    return Reader(plain)


def test_a_page_is_well_formed_and_whole(plain, reader):
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
        clips = re.findall(r"url\(#(.*?)\)", attributes.get("clip-path") or "")
        assert set(clips) <= set(ids)
    assert reader.named("a")[0]["href"] == "#_content"
    reader = Reader(re.sub("<details>.*?</details>", "", plain, flags=re.DOTALL))
    assert len(reader.named("table")) == len(reader.named("caption")) == 3  # the wide one is two
    assert {a.get("scope") for a in reader.named("th")} == {"col", "row", "rowgroup"}
    assert "Wide (continued)" in plain


def test_figures_have_words_and_numbers(plain, reader):
    charts = every_mark()
    assert len(reader.named("figure")) == len(reader.named("figcaption")) == len(charts)
    drawings = [a for a in reader.named("svg") if a.get("role") == "img"]
    assert [a["aria-label"] for a in drawings] == [chart.alt for chart in charts]
    for chart in charts:
        assert chart.caption in plain
        (tables,) = re.findall(f'id="{chart.key}".*?<details>(.*?)</details>', plain, re.DOTALL)
        assert "nan" not in tables
        for table in number_tables(chart.figure):
            for columns in table.by_columns(6):
                assert f">{columns.caption or 'Numbers'}</caption>" in tables
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
    assert max(float(row[1]) for row in table.rows) == pytest.approx(peak.max(), rel=1e-4)


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


def test_nothing_is_fetched(plain, reader):
    assert {"link", "img", "iframe", "script"}.isdisjoint(tag for tag, _ in reader.elements)
    (policy,) = [a for a in reader.named("meta") if "http-equiv" in a]
    assert "default-src 'none'" in policy["content"]
    assert "http" not in policy["content"]
    assert "@import" not in plain
    for image in reader.named("image"):
        assert image["xlink:href"].startswith("data:image/png;base64,")


def test_hostile_names_stay_names(reader):
    hostile = Reader(page_html(whole_page(HOSTILE)).decode())
    assert {tag for tag, _ in hostile.elements} == {tag for tag, _ in reader.elements}
    assert hostile.texts["title"][0] == f"Page of {HOSTILE}"
    assert HOSTILE in hostile.texts["th"]  # of a table of numbers


def contrast(*shades):
    """Contrast ratio of WCAG 2.2 of two texts "#rrggbb"."""
    parts = np.array([[*bytes.fromhex(shade[1:])] for shade in shades]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    dark, light = np.sort(linear @ [0.2126, 0.7152, 0.0722])
    return (light + 0.05) / (dark + 0.05)


def test_contrast_of_texts(plain):
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    shades = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", plain))
    pairs = [(ink, "paper") for ink in ("ink", "soft", "link", "good", "note", "bad")]
    pairs += [("ink", f"{kind}tint") for kind in ("", "note-", "good-")] + [("bad", "bad-tint")]
    for ink, paper in pairs:
        assert contrast(shades[ink], shades[paper]) >= 4.5, (ink, paper)


def test_without_the_extra_a_pdf_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    words = r'a page as PDF needs WeasyPrint and Pango: pip install "lbt-synth\[pdf\]"'
    with pytest.raises(lbt.errors.MissingExtraError, match=words) as caught:
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
    page = new_page("bad\udcff", "one", {"Empty": (), "Words": ("words",)}, sources=sources)
    assert list(page.sections) == ["Words", "Files and versions"]
    files, programs, listing = page.sections["Files and versions"]
    assert page.digests == {row[0]: row[2] for row in files.rows}
    assert page.digests["b.fits"] == hashlib.sha256(b"b").hexdigest()
    assert programs.rows[0] == ("lbt_synth", lbt.__version__)
    assert listing == ("Configuration a.yaml", "a: 1\n")
    assert page.subtitle == f"one. Made {page.made}."
    assert b"bad\\udcff" in page_html(page)  # a name that is no text has an escape


def test_the_creation_time(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert creation_time() == "1970-01-02 00:00:00 UTC"
    for wrong in ("tomorrow", "1e400", str(10**30)):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", wrong)
        with pytest.raises(lbt.errors.ProblemError, match="SOURCE_DATE_EPOCH must be a number"):
            creation_time()
