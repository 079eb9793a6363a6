"""Pages in headless Chromium: they open offline, are drawn, fit a phone and a sheet of paper."""

from __future__ import annotations

import base64
import re
import time

import pytest
from support.pages import HOSTILE, every_mark, whole_page
from support.plants import LBT_YAML
from support.study_pages import page_of, results

import lbt_synth as lbt
from lbt_synth.report.page.html import page_html

pytestmark = pytest.mark.browser

OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--host-resolver-rules=MAP * ~NOTFOUND",
)
PHONE = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
DESK = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
# elements in the page and in shadow roots below one
WALK = """
function* walk(node) {
  yield node;
  if (node.shadowRoot) for (const child of node.shadowRoot.children) yield* walk(child);
  for (const child of node.children) yield* walk(child);
}
"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Addresses of a real report, a study, and a page with every kind of mark and hostile names."""
    folder = tmp_path_factory.mktemp("browser")
    config = lbt.load_config(LBT_YAML)
    designs = {
        "kalman": lbt.kalman(config.plant),
        "integrator with a rather long name of its file": lbt.integrator(config.hardware, gain=0.4),
    }
    lbt.report.write_report(lbt.report.design_report(config, designs), folder / "report.html")
    (folder / "study.html").write_bytes(page_html(page_of(results())))
    (folder / "marks.html").write_bytes(page_html(whole_page()))
    (folder / "hostile.html").write_bytes(page_html(whole_page(HOSTILE)))
    return {path.stem: path.as_uri() for path in folder.glob("*.html")}


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    profile = tmp_path_factory.mktemp("profile")
    for option in (*OPTIONS, f"--user-data-dir={profile}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    service = webdriver.ChromeService(executable_path="/usr/bin/chromedriver")
    driver = webdriver.Chrome(options=options, service=service)
    driver.execute_cdp_cmd("Network.enable", {})
    driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": ["http://*", "https://*", "ws://*"]})
    offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
    driver.execute_cdp_cmd("Network.emulateNetworkConditions", offline)
    yield driver
    driver.quit()


def opened(browser, address, screen=DESK, *, script=True):
    """Open a page, wait until its charts are drawn, and return all that was requested."""
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": screen["mobile"]})
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": not script})
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get(address)
    end = time.monotonic() + 60
    while (
        script and browser.execute_script("return document.documentElement.dataset.drawn") != "yes"
    ):
        assert time.monotonic() < end, browser.get_log("browser")
        time.sleep(0.1)
    time.sleep(0.5)


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


def chain(browser):
    """Return what the hand does next."""
    from selenium.webdriver import ActionChains

    return ActionChains(browser)


def drawn_plots(browser):
    """For each plot its size, and how many of its pixels are not blank."""
    return browser.execute_script(
        WALK
        + """
        return [...document.querySelectorAll(".plot")].map(place => {
          let ink = 0, box = place.getBoundingClientRect();
          for (const node of walk(place)) {
            if (node.tagName !== "CANVAS" || !node.width) continue;
            const data = node.getContext("2d").getImageData(0, 0, node.width, node.height).data;
            for (let i = 0; i < data.length; i += 4)
              if (data[i + 3] > 128 && data[i] + data[i + 1] + data[i + 2] < 720) ink += 1;
          }
          return [place.id, box.width, box.height, ink];
        });
        """
    )


@pytest.mark.parametrize("screen", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.parametrize("name", ["report", "study", "marks"])
def test_every_figure_is_drawn(browser, pages, name, screen):
    opened(browser, pages[name], screen)
    plots = drawn_plots(browser)
    figures = browser.execute_script("return document.querySelectorAll('figure').length")
    assert len(plots) >= figures >= 3
    for place, width, height, ink in plots:
        assert width > 200, place
        assert height > 100, place
        assert ink > 500, place
    hidden = "return [...document.querySelectorAll('.static')].every(e => e.offsetHeight === 0)"
    assert browser.execute_script(hidden)


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


def tooltips(browser):
    return browser.execute_script(
        WALK
        + """
        const found = [];
        for (const node of walk(document.body))
          if (node.classList && node.classList.contains("bk-Tooltip") && node.offsetHeight)
            found.push([...walk(node)].filter(e => e.tagName !== "STYLE").map(e => [...e.childNodes].filter(c => c.nodeType === 3)
              .map(c => c.textContent).join("")).join(" "));
        return found;
        """
    )


@pytest.mark.parametrize(
    ("name", "place", "words"),
    [
        ("report", "robustness_panel-1", ("frequency error", "Hz", "kalman", "%")),
        ("report", "map_panel-1", ("sensor gain", "Strehl ratio", "%")),
        ("hostile", "lines_panel-2", ("frequency", "Hz", "<b>&\"'$x$ $$y$$", "nm")),
        ("marks", "rest_panel-1", ("a.b", "first order", "interval")),
    ],
)
def test_the_pointer_shows_values(browser, pages, name, place, words):
    opened(browser, pages[name])
    plot = browser.find_element("id", place)
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", plot)
    found = []
    for x, y in ((-10, -5), (20, 0), (-150, -40), *((-320, y) for y in range(-60, 60, 8))):
        chain(browser).move_to_element_with_offset(plot, x, y).perform()
        time.sleep(0.4)
        found += [tip for tip in tooltips(browser) if all(word in tip for word in words)]
        if found:
            break
    assert found
    assert re.search(r"\d", found[0])


def test_the_legend_hides_lines(browser, pages):
    opened(browser, pages["marks"])
    before = {place: ink for place, _, _, ink in drawn_plots(browser)}
    buttons = browser.find_elements("css selector", "#lines .legend button")
    button = next(b for b in buttons if b.text == "first")
    assert button.get_attribute("aria-pressed") == "true"
    button.send_keys("\ue007")
    time.sleep(0.5)
    assert button.get_attribute("aria-pressed") == "false"
    after = {place: ink for place, _, _, ink in drawn_plots(browser)}
    for place in ("lines_panel-1", "lines_panel-2"):
        assert after[place] < before[place]
    button.send_keys("\ue007")
    time.sleep(0.5)
    assert {place: ink for place, _, _, ink in drawn_plots(browser)} == before


def test_a_drag_zooms(browser, pages):
    opened(browser, pages["marks"])
    plot = browser.find_element("id", "lines_panel-2")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", plot)
    end = "return Bokeh.documents[0].roots()[1].x_range.end"
    whole = browser.execute_script(end)
    actions = chain(browser)
    actions.move_to_element_with_offset(plot, -100, -20).click_and_hold()
    for _ in range(5):
        actions.move_by_offset(30, 8).pause(0.05)
    actions.release().perform()
    time.sleep(0.5)
    assert browser.execute_script(end) < whole


@pytest.mark.parametrize("screen", [DESK, PHONE], ids=["desk", "phone"])
def test_circles_are_round(browser, pages, screen):
    opened(browser, pages["report"], screen)
    scales = browser.execute_script(
        """
        const index = [...document.querySelectorAll(".plot")].findIndex(e => e.id === "poles_panel-1");
        const plot = Bokeh.documents[0].roots()[index];
        return [plot.inner_width / (plot.x_range.end - plot.x_range.start),
                plot.inner_height / (plot.y_range.end - plot.y_range.start)];
        """
    )
    assert scales[0] > 50
    assert scales[0] / scales[1] == pytest.approx(1, abs=0.03)


def test_a_finger_scrolls_the_page(browser, pages):
    opened(browser, pages["marks"], PHONE)
    active = "return Bokeh.documents[0].roots().map(plot => plot.toolbar.active_drag)"
    assert not any(browser.execute_script(active))
    styles = browser.execute_script(
        WALK
        + """
        return [...walk(document.getElementById("lines_panel-1"))]
          .filter(e => e.classList && e.classList.contains("bk-events"))
          .map(e => getComputedStyle(e).touchAction);
        """
    )
    assert styles
    assert set(styles) == {"auto"}


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
        one, other = (
            [int(v) / 255 for v in re.findall(r"\d+", shade)[:3]] for shade in pair.split("|")
        )
        dark, light = sorted(_luminance(shade) for shade in (one, other))
        assert (light + 0.05) / (dark + 0.05) >= 4.5, pair


def _luminance(shade):
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in shade]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


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
