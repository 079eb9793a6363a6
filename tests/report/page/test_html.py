"""Pages as one HTML file: whole, with words for every figure, and safe from hostile names."""

from __future__ import annotations

import json
import re
from itertools import pairwise

import numpy as np
import pytest
from support.pages import HOSTILE, Reader, every_mark, whole_page

from lbt_synth.report.page.blocks import Page, Paragraph, Section
from lbt_synth.report.page.html import page_html


@pytest.fixture(scope="module")
def plain():
    return page_html(whole_page()).decode()


@pytest.fixture(scope="module")
def hostile():
    return page_html(whole_page(HOSTILE)).decode()


def data_of(text):
    (found,) = re.findall(r'<script type="application/json" id="_charts">(.*?)</script>', text)
    return json.loads(found)


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
    reader = Reader(plain)
    tables = reader.named("table")
    assert len(tables) == len(reader.named("caption")) == 3  # the wide one is two
    assert {a.get("scope") for a in reader.named("th")} == {"col", "row", "rowgroup"}
    assert "Wide (continued)" in plain


def test_figures_have_words(plain):
    reader = Reader(plain)
    charts = every_mark()
    assert len(reader.named("figure")) == len(reader.named("figcaption")) == len(charts)
    drawings = [a for a in reader.named("svg") if a.get("role") == "img"]
    assert [a["aria-label"] for a in drawings] == [chart.alt for chart in charts]
    for chart in charts:
        assert plain.count(chart.caption) >= 1


def test_nothing_is_fetched(plain):
    reader = Reader(plain)
    assert not reader.named("link")
    assert not reader.named("img")
    assert not reader.named("iframe")
    assert all("src" not in a for a in reader.named("script"))
    (policy,) = [a for a in reader.named("meta") if "http-equiv" in a]
    assert "default-src 'none'" in policy["content"]
    assert "http" not in policy["content"]
    assert "@import" not in plain
    for image in reader.named("image"):
        assert image["xlink:href"].startswith("data:image/png;base64,")


def test_hostile_names_stay_names(hostile, plain):
    reader, usual = Reader(hostile), Reader(plain)
    assert len(reader.elements) == len(usual.elements)
    assert [tag for tag, _ in reader.elements] == [tag for tag, _ in usual.elements]
    assert len(reader.named("script")) == 3
    outside = re.sub(r"<script>.*?</script>", "", hostile, flags=re.DOTALL)
    assert "alert(1)</script>" not in outside
    assert reader.texts["title"][0] == f"Page of {HOSTILE}"
    names = json.dumps(data_of(hostile))
    assert "alert(1)" in names  # a name that the pointer shows
    raw = re.search(r'id="_charts">(.*?)</script>', hostile, flags=re.DOTALL)
    assert raw is not None
    assert not set("<>&") & set(raw[1])


def test_a_page_without_charts_has_no_script():
    page = Page(
        title="t",
        subtitle="s",
        creator="c",
        sections=(Section(key="a", title="A", blocks=(Paragraph(text="words"),)),),
    )
    text = page_html(page).decode()
    assert len(text) < 20_000
    assert "<script" not in text
    Reader(text)


def luminance(shade):
    parts = np.array([int(shade[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one, other):
    """Contrast ratio of WCAG 2.2."""
    dark, light = sorted([luminance(one), luminance(other)])
    return (light + 0.05) / (dark + 0.05)


def test_contrast_of_texts(plain):
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    named = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", plain))
    for ink, paper in (
        ("ink", "paper"),
        ("soft", "paper"),
        ("link", "paper"),
        ("ink", "tint"),
        ("bad", "bad-tint"),
        ("good", "paper"),
        ("note", "paper"),
        ("ink", "note-tint"),
        ("ink", "good-tint"),
        ("bad", "paper"),
    ):
        assert contrast(named[ink], named[paper]) >= 4.5, (ink, paper)
