"""Pages: charts, tables and words, as HTML and as PDF."""

from __future__ import annotations

import json
import re
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.pages import HOSTILE, Reader, every_mark, whole_page

import lbt_synth as lbt
from lbt_synth.report.line_styles import colour, dashes, marker_name
from lbt_synth.report.page.blocks import Listing, Page, Paragraph, Section
from lbt_synth.report.page.bokeh_charts import embed_charts
from lbt_synth.report.page.charts import Area, Axis, Bars, Chart, Curve, Map, Panel, legend_entries
from lbt_synth.report.page.html import page_html
from lbt_synth.report.page.matplotlib_charts import chart_height, chart_style, chart_svg, draw_chart
from lbt_synth.report.page.pdf import HEIGHT, block_height, page_pdf, split_by_sheets
from lbt_synth.report.page.scales import log_tick_texts, log_ticks, scale_ends, shorten
from lbt_synth.report.page.typeset import BODY, MONO, mono_lines, text_width, wrap
from lbt_synth.storage.tables import Cell, Table


@pytest.fixture(scope="module")
def plain():
    return page_html(whole_page()).decode()


@pytest.fixture(scope="module")
def hostile():
    return page_html(whole_page(HOSTILE)).decode()


@pytest.fixture(scope="module")
def sheets():
    return page_pdf(whole_page())


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


def test_the_same_page_is_the_same_file(plain, sheets):
    assert page_html(whole_page()).decode() == plain
    assert page_pdf(whole_page()) == sheets


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


def test_the_data_of_charts_are_those_given(plain):
    chart = every_mark()[0]
    drawn = embed_charts([chart])
    numbers = json.dumps(drawn.embedding)
    assert set(drawn.lines["lines"]) == set(legend_entries(chart.panels)) - {"only named"}
    for identifiers in drawn.lines["lines"].values():
        for identifier in identifiers:
            assert numbers.count(f'"{identifier}"') >= 1
    assert len(drawn.lines["lines"]["first"]) == 2  # once a panel
    assert drawn.places == {"lines": ("lines_panel-1", "lines_panel-2")}
    assert '"x": "p' not in numbers


def texts_of(svg):
    return re.findall(r"<text[^>]*>(.*?)</text>", svg)


def test_drawings_keep_their_text():
    svg = chart_svg(every_mark()[0])
    words = texts_of(svg)
    for word in ("frequency [Hz]", "size [-]", "steps [nm]", "first", "second", "only named"):
        assert word in words
    assert svg == chart_svg(every_mark()[0])
    assert 'viewBox="0 0' in svg
    assert " width=" not in svg.split(">")[0]
    strange = chart_svg(every_mark("$\\frac{$ 文字")[0])  # no mathematics, and no such glyph
    assert "$\\frac{$ 文字" in texts_of(strange)


def test_unequal_looks_are_told_apart():
    looks = [(colour(i), dashes(i)) for i in range(36)]
    assert len(set(looks)) == 36
    marks = {(colour(i), marker_name("own", i)) for i in range(36)}
    assert len(marks) == 36
    assert colour(None) not in [look[0] for look in looks]
    assert marker_name("cross", 3) == "cross"


@pytest.mark.parametrize(
    ("axis", "values", "ends"),
    [
        (Axis(label="x"), [1.0, 3.0], (1.0, 3.0)),
        (Axis(label="x", low=0.0), [1.0, 3.0], (0.0, 3.0)),
        (Axis(label="x", log=True), [-1.0, 0.0, 0.1, 10.0, np.nan], (0.1, 10.0)),
        (Axis(label="x"), [5.0], (4.5, 5.5)),
        (Axis(label="x"), [], (0.9, 1.1)),
        (Axis(label="x", log=True), [], (np.exp(-0.5), np.exp(0.5))),
        (Axis(label="x"), [0.0], (-0.5, 0.5)),
    ],
)
def test_ends_of_scales(axis, values, ends):
    curve = Curve(name="a", x=values, y=np.ones(len(values)))
    found, _ = scale_ends(Panel(x=axis, y=Axis(label="y"), marks=(curve,)))
    assert found == pytest.approx(ends)


@pytest.mark.parametrize(
    ("axis", "marker", "values", "ends"),
    [
        # room is of what is shown, not of what the values span
        (Axis(label="y", unit="%", low=0.0), "own", [98.0, 100.0], (0.0, 104.0)),
        # markers on an end that is given, and lines along it, are not cut
        (Axis(label="y", unit="%", low=0.0), "own", [0.0, 100.0], (-4.0, 104.0)),
        (Axis(label="y", low=0.0, high=100.0), None, [100.0, 100.0, 50.0], (0.0, 104.0)),
        (Axis(label="y", low=0.0, high=100.0), None, [0.0, 100.0, 50.0], (0.0, 100.0)),
        (Axis(label="y", log=True, low=1.0), "own", [1.0, 100.0], (100**-0.04, 100**1.04)),
        (Axis(label="y", low=5.0), None, [1.0, 2.0], (5.0, 6.0 + 0.04)),
    ],
)
def test_curves_are_not_cut_by_the_ends_of_their_scale(axis, marker, values, ends):
    curve = Curve(name="a", x=np.arange(len(values)), y=values, marker=marker)
    panel = Panel(x=Axis(label="x"), y=axis, marks=(curve,))
    _, found = scale_ends(panel)
    assert found == pytest.approx(ends)
    shaded = Area(name="b", x=curve.x, low=curve.y, high=curve.y)
    standing = scale_ends(Panel(x=Axis(label="x"), y=axis, marks=(curve, shaded)))[1]
    assert standing[0] == pytest.approx(axis.low)


def test_both_renderers_leave_the_same_room():
    curve = Curve(name="a", x=[0.0, 1.0, 2.0], y=[0.0, 99.0, 100.0], marker="own")
    panel = Panel(x=Axis(label="x"), y=Axis(label="y", low=0.0), marks=(curve,))
    chart = Chart(key="room", title="t", caption="c", alt="a", panels=(panel,))
    data = embed_charts([chart]).embedding["documents"]["page"]["roots"][0]["attributes"]
    ends = data["y_range"]["attributes"]
    assert (ends["start"], ends["end"]) == pytest.approx((-4.0, 104.0))
    figure = Figure(figsize=(7, chart_height(chart)))
    draw_chart(figure, chart, left=0, top=chart_height(chart))
    assert figure.axes[0].get_ylim() == pytest.approx((-4.0, 104.0))


def test_ticks():
    assert log_ticks(0.1, 400) == pytest.approx([0.1, 1, 10, 100])
    assert log_ticks(20, 300) == pytest.approx([20, 50, 100, 200])
    assert len(log_ticks(1e-9, 1e9)) < 10
    assert log_ticks(64.0, 171.0) == pytest.approx([80, 100, 120, 140, 160])  # not 100 alone
    for ratio in (1.001, 1.1, 1.9, 3.0, 5.0, 9.9):
        for low in np.geomspace(1, 10, 23):
            ticks = log_ticks(low, ratio * low)
            assert 3 <= len(ticks) <= 9
            assert low * (1 - 1e-9) <= ticks[0] < ticks[-1] <= ratio * low * (1 + 1e-9)
    assert log_tick_texts([1.2e5, 1.25e5]) == ["1.2·10⁵", "1.25·10⁵"]
    assert log_tick_texts([0.001, 0.1, 2, 10_000]) == ["0.001", "0.1", "2", "10000"]
    assert log_tick_texts([1e-6, 1.0, 2e5]) == ["10⁻⁶", "10⁰", "2·10⁵"]
    assert shorten("abcdefghij", 5) == "ab…ij"
    assert shorten("abc", 5) == "abc"


def test_lines_fit_their_width():
    words = "some words and an_extremely_long_name_" + 80 * "x" + " and the end"
    lines = wrap(words, BODY, 2.0)
    assert all(text_width(line, BODY) <= 2.0 for line in lines)
    assert "".join(lines).replace(" ", "") == words.replace(" ", "")
    assert all(text_width(line, MONO) <= 3.0 for line in mono_lines(200 * "m", 3.0))
    assert mono_lines("a\n\nb", 3.0) == ["a", "", "b"]


def pages_of(pdf):
    return len(re.findall(rb"/Type /Page\b", pdf))


def test_a_pdf_has_its_pages_and_no_date(sheets):
    pdf = sheets
    assert pdf.startswith(b"%PDF")
    assert pages_of(pdf) == 4
    assert b"CreationDate" not in pdf
    assert b"/Title (Page of first)" in pdf
    assert b"/MediaBox [ 0 0 595.44 841.68 ]" in pdf
    assert b"/Type3" not in pdf
    assert page_pdf(whole_page(HOSTILE)).startswith(b"%PDF")


def many_panels(count, title="p", columns=2):
    x = np.linspace(0, 1, 5)
    panel = Panel(
        title=title, x=Axis(label="x"), y=Axis(label="y"), marks=(Curve(name="a", x=x, y=x),)
    )
    return Chart(
        key="many", title="Many", caption="c", alt="a", panels=count * (panel,), columns=columns
    )


@pytest.mark.parametrize("count", [1, 6, 7, 40])
def test_charts_that_are_too_high_go_on_on_the_next_sheet(count):
    chart = many_panels(count)
    parts = list(split_by_sheets(chart))
    assert sum(len(part.panels) for part in parts) == count
    assert all(block_height(part) <= HEIGHT - 1.25 - 0.5 for part in parts)
    assert [part.title for part in parts[:2]] == ["Many", "Many (continued)"][: len(parts)]
    page = Page(
        title="t",
        subtitle="s",
        creator="c",
        sections=(
            Section(key="a", title="A", blocks=(Paragraph(text="a"),)),
            Section(key="b", title="B", blocks=(chart,)),
        ),
    )
    assert pages_of(page_pdf(page)) == len(parts) + (count >= 6)


def test_bars_fit_a_sheet():
    names = tuple(f"parameter {i}" for i in range(60))
    bars = tuple(Bars(name=f"c{i}", values=np.ones(60), look=i) for i in range(3))
    panel = Panel(x=Axis(label="x", low=0), y=Axis(label="y"), marks=bars, categories=names)
    chart = Chart(key="bars", title="t", caption="c", alt="a", panels=(panel,))
    assert block_height(chart) <= HEIGHT - 1.25 - 0.5


def test_titles_of_panels_stay_in_their_drawing():
    title = "a very long name " * 10
    for columns in (1, 2, 3):
        figure = Figure(figsize=(7, 12))
        with chart_style():
            draw_chart(figure, many_panels(columns, title, columns), left=0, top=12)
            figure.canvas.draw()
            for axes in figure.axes:
                told = axes.get_title(loc="left")
                assert "…" in told
                ends = axes._left_title.get_window_extent()
                assert ends.x1 <= axes.get_window_extent().x1 + 1


def test_long_listings_and_tables_go_on_on_the_next_sheet():
    def count(block):
        section = Section(key="a", title="A", blocks=(block,))
        page = Page(title="t", subtitle="s", creator="c", sections=(section,))
        return pages_of(page_pdf(page))

    inside = HEIGHT - 0.6 - 0.65
    assert count(Listing(caption="l", text="line\n" * 10)) == 1
    used = 0.25 + 0.15 + 0.2 + 0.55 + 1000 * MONO.leading  # headings
    assert count(Listing(caption="l", text="line\n" * 1000)) == pytest.approx(
        np.ceil(used / inside), abs=1
    )
    rows = tuple((f"row {i}", "value") for i in range(200))
    assert 3 <= count(Table(caption="t", headings=("a", "b"), rows=rows)) <= 5


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


X, Y = Axis(label="x"), Axis(label="y")
DOT = Curve(name="a", x=[1.0], y=[1.0])


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Curve(name="a", x=[1, 2], y=[1]), "same length"),
        (lambda: Curve(name="a", x=[1], y=[1], line=False), "a line or a marker"),
        (lambda: Curve(name="a", x=[1], y=[1], marker="star"), "marker must be one of"),
        (lambda: Map(x=[1, 2], y=[1], values=[[1]], label="v"), "a column for each of 2 x"),
        (lambda: Map(x=[2, 1], y=[1], values=[[1, 2]], label="v"), "x of a map must increase"),
        (lambda: Map(x=[1], y=[1], values=[[1]], label="v", low=1), "low must be below high"),
        (
            lambda: Panel(x=X, y=Y, marks=(Bars(name="a", values=[1]),)),
            "a value for each of 0 categories",
        ),
        (
            lambda: Chart(key="A b", title="t", caption="c", alt="a", panels=()),
            "a key must be of small letters",
        ),
        (lambda: Chart(key="a", title="t", caption="c", alt=" ", panels=()), "words for its alt"),
        (lambda: Chart(key="a", title="t", caption="c", alt="a", panels=()), "one panel"),
        (lambda: Table(caption="t", headings=("a", "b", "c"), rows=(("1", "2"),)), "1 or 3 cells"),
        (lambda: Cell(text="a", tone="loud"), "tone must be one of"),
        (
            lambda: Page(
                title="t",
                subtitle="s",
                creator="c",
                sections=tuple(Section(key="a", title="a", blocks=()) for _ in range(2)),
            ),
            "keys of a page must be unique; got a twice",
        ),
    ],
)
def test_mistakes_are_refused(make, text):
    with pytest.raises(lbt.errors.ProblemError, match=re.escape(text)):
        make()
