"""Pages as one HTML file: whole, with words for every figure, and safe from hostile names."""

import base64
import json
import re
from itertools import pairwise

import numpy as np
import pytest
from support.browser import DESK, PHONE, chain, opened
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
        sections=(Section(key="a", title="A", blocks=(Paragraph(text="words"),)),),
    )
    text = page_html(page).decode()
    assert len(text) < 20_000
    assert "<script" not in text
    Reader(text)


def luminance(shade):
    """Of "#rrggbb" or "rgb(r, g, b)"."""
    if shade[0] == "#":
        parts = np.array([int(shade[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    else:
        parts = np.array([int(v) / 255 for v in re.findall(r"\d+", shade)[:3]])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one, other):
    """Contrast ratio of WCAG 2.2."""
    dark, light = sorted([luminance(one), luminance(other)])
    return (light + 0.05) / (dark + 0.05)


def test_contrast_of_texts(plain):
    assert contrast("#000000", "rgb(255, 255, 255)") == pytest.approx(21)
    named = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", plain))
    on_paper = [(ink, "paper") for ink in ("ink", "soft", "link", "good", "note", "bad")]
    on_tints = [("ink", f"{kind}tint") for kind in ("", "note-", "good-")]
    for ink, paper in (*on_paper, *on_tints, ("bad", "bad-tint")):
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
    assert (
        browser.execute_script("return window.hacked === undefined && Bokeh.documents.length") == 1
    )


@pytest.mark.browser
@pytest.mark.parametrize("name", ["report", "study", "marks", "hostile"])
def test_it_fits_a_phone(browser, pages, name):
    opened(browser, pages[name], PHONE)
    widths = browser.execute_script(
        "return [document.documentElement.scrollWidth, document.body.scrollWidth, innerWidth]"
    )
    assert max(widths) <= 360
    out = browser.execute_script(
        """
        const out = [];
        for (const node of document.body.querySelectorAll("*")) {
          if (node.closest(".scroll, pre, .skip, .static")) continue;
          const box = node.getBoundingClientRect();
          if (box.width && (box.right > innerWidth + 1 || box.left < -1))
            out.push([node.tagName, node.className, box.left, box.right]);
        }
        return out;
        """
    )
    assert out == []
    small = browser.execute_script(
        """
        return [...document.querySelectorAll("p, td, th, a, figcaption, button, pre")]
          .filter(e => e.offsetHeight && parseFloat(getComputedStyle(e).fontSize) < 12).length
        """
    )
    assert small == 0


@pytest.mark.browser
def test_a_table_wider_than_the_screen_says_so(browser, pages):
    script = """
        return [...document.querySelectorAll(".scroll")].map(e => [
          e.scrollWidth > e.clientWidth + 1,
          getComputedStyle(e, "::before").content.includes("scroll sideways"),
        ])
    """
    opened(browser, pages["report"], PHONE)
    phone = browser.execute_script(script)
    assert any(wide for wide, _ in phone)
    assert all(wide == said for wide, said in phone)
    opened(browser, pages["report"], DESK)
    assert all(wide == said for wide, said in browser.execute_script(script))


@pytest.mark.browser
@pytest.mark.parametrize("name", ["report", "study", "marks", "hostile"])
def test_it_fits_a_sheet_of_paper(browser, pages, name):
    opened(browser, pages[name])
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    inside = {**DESK, "width": 688, "height": 1009}  # A4 less the margins, at 96 pixels an inch
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", inside)
    out = browser.execute_script(
        """
        const out = [];
        for (const node of document.body.querySelectorAll("*")) {
          if (node.closest(".skip, defs")) continue;
          const box = node.getBoundingClientRect();
          if (box.width && box.right > innerWidth + 1) out.push([node.tagName, box.right]);
        }
        return [out, [...document.querySelectorAll(".static svg")].map(e => e.clientHeight),
                [...document.querySelectorAll(".plot")].every(e => e.offsetHeight === 0),
                document.documentElement.scrollWidth];
        """
    )
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert out[0] == []
    assert 200 < min(out[1]) <= max(out[1]) < 1009
    assert out[2]
    assert out[3] <= 688
    options = {"preferCSSPageSize": True, "printBackground": True}
    pdf = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", options)["data"])
    sheets = len(re.findall(rb"/Type\s*/Page\b", pdf))
    assert (7 if name == "report" else 3) <= sheets <= 15
    boxes = {tuple(map(float, box.split())) for box in re.findall(rb"/MediaBox\s*\[(.*?)\]", pdf)}
    assert all(box[2:] == pytest.approx((595, 842), abs=1) for box in boxes)


@pytest.mark.browser
def test_without_javascript_the_drawings_show(browser, pages):
    opened(browser, pages["report"], script=False)
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
    sizes = browser.execute_script(
        """return [...document.querySelectorAll(".static svg")].map(e => {
             const box = e.getBoundingClientRect(); return [box.width, box.height]; })"""
    )
    shown = "return [...document.querySelectorAll('.interactive')].some(e => e.offsetHeight)"
    assert not browser.execute_script(shown)
    assert len(sizes) >= 8
    assert all(width > 500 and height > 100 for width, height in sizes)


@pytest.mark.browser
def test_the_keyboard_reaches_the_content(browser, pages):
    opened(browser, pages["report"])
    keys = chain(browser)
    keys.send_keys("\ue004").perform()  # tabulator
    active = "return document.activeElement"
    assert browser.execute_script(f"{active}.className") == "skip"
    assert browser.execute_script(f"return {active[7:]}.getBoundingClientRect().left") >= 0
    chain(browser).send_keys("\ue007").perform()  # enter
    assert browser.execute_script("return location.hash") == "#_content"
    assert browser.execute_script(f"{active}.id") == "_content"
    for link in browser.find_elements("css selector", "nav a"):
        target = link.get_attribute("href").split("#")[1]
        browser.execute_script("arguments[0].focus()", link)
        link.send_keys("\ue007")
        assert browser.execute_script("return location.hash") == f"#{target}"
        box = f"return document.getElementById('{target}').getBoundingClientRect()"
        assert browser.execute_script(f"{box}.top") < 900
        assert browser.execute_script(f"{box}.bottom") > 0


@pytest.mark.browser
def test_texts_have_contrast(browser, pages):
    opened(browser, pages["marks"])
    pairs = browser.execute_script(
        """
        const pairs = new Set();
        for (const node of document.querySelectorAll("h1,h2,h3,p,a,td,th,caption,figcaption,span,code,button,li")) {
          if (!node.offsetHeight || !node.textContent.trim()) continue;
          let ground = node, colour = "rgba(0, 0, 0, 0)";
          while (ground && colour === "rgba(0, 0, 0, 0)") {
            colour = getComputedStyle(ground).backgroundColor;
            ground = ground.parentElement;
          }
          pairs.add(getComputedStyle(node).color + "|" + colour);
        }
        return [...pairs];
        """
    )
    assert len(pairs) > 4
    for pair in pairs:
        assert contrast(*pair.split("|")) >= 4.5, pair


@pytest.mark.browser
def test_the_accessibility_tree_names_what_matters(browser, pages):
    opened(browser, pages["marks"])
    nodes = browser.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    named = {}
    for node in nodes:
        if not node.get("ignored"):
            role = node["role"]["value"]
            named.setdefault(role, []).append(node.get("name", {}).get("value", ""))
    for role in ("figure", "table", "button", "link", "heading", "main", "navigation"):
        assert named[role], role
        assert all(name.strip() for name in named[role] if role != "main"), role
    assert set(named["figure"]) >= {chart.title for chart in every_mark()}
