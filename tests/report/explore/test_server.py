"""The page of sliders in Chromium: every slider, every curve, keyboard, phone, files."""

import json
import re
import time
from dataclasses import replace
from pathlib import Path
from queue import Queue
from threading import Event

import numpy as np
import pytest
from bokeh.document import Document
from support.browser import DESK, PHONE, chain, chromium
from support.commands import run
from support.configs import write_config
from support.explore import asked, await_state, choose, five_lines, move, reset, select, served
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.report.explore import server
from lbt_synth.report.explore.exploration import explore, quick_view, whole_view
from lbt_synth.report.explore.server import Lane, LivePanel, Session, explore_numbers, save_view
from lbt_synth.storage.display_unit import nm_text, own_display_unit, show_in

# numbers of all sources, by the chart that draws them
CURVES = """
const numbers = {};
for (const root of Bokeh.documents[0].roots()) {
  const figure = root.children[0][0];
  numbers[root.name] = JSON.stringify(figure.renderers.map(
    (one) => Object.entries(one.data_source.data).map(([name, column]) => [name, [...column]])));
}
return numbers;
"""


class Page:
    """A document whose callbacks run when the test says so."""

    def __init__(self, *arguments):
        self.document, self._later = Document(), Queue()
        self.document.add_next_tick_callback = self._later.put
        self.session = Session(self.document, *arguments, [])
        self.exchange = self.document.get_model_by_name("exchange")

    def ask(self, **message):
        self.exchange.wish = json.dumps({"method": "kalman", "final": False, **message})

    def wait(self, name, found):
        """Run what is to be done on the document until the page hears this."""
        while not found(heard := json.loads(getattr(self.exchange, name) or "{}")):
            self._later.get(timeout=30)()
        return heard

    def close(self):
        self.session._close(None)


@pytest.fixture(scope="module")
def exploration():
    return explore(lbt.load_config(LBT_YAML), {})


@pytest.fixture(scope="module")
def first(exploration):
    return whole_view(exploration, quick_view(exploration))


@pytest.fixture
def own(exploration, first, tmp_path):
    page = Page(exploration, first, tmp_path)
    yield page
    page.close()


def is_whole(number):
    return lambda heard: heard.get("number") == number and heard.get("whole", True)


def test_a_wish_is_answered(own):
    before = own.wait("answer", is_whole(0))
    own.ask(do="design", number=1, values={"delay": 3}, final=True)
    after = own.wait("answer", is_whole(1))
    assert after["rows"][0][0] == before["rows"][0][0] == "Kalman"
    assert after["rows"] != before["rows"]
    said = own.wait("verdict", lambda heard: heard.get("number") == 1)
    assert f"leaves {after['rows'][0][1]} nm rms" in said["text"]


def test_an_error_is_said_and_the_curves_stay(own):
    shown = own.wait("answer", is_whole(0))
    own.ask(do="design", number=1, method="kalmann", values={})
    assert "Did you mean kalman" in own.wait("answer", is_whole(1))["error"]
    own.ask(do="design", number=2, values={"delay": "three"})
    assert own.wait("answer", is_whole(2))["error"].startswith("ValueError: ")
    own.ask(do="design", number=3, values={})
    assert own.wait("answer", is_whole(3))["rows"] == shown["rows"]


def test_results_that_come_late_are_not_shown(own):
    view = own.session._view
    own.ask(do="design", number=5, values={"gain": 0.5})
    newest = own.wait("answer", is_whole(5))
    own.session._show_view(4, view)
    own.session._complain(4, ValueError("late"))
    assert json.loads(own.exchange.answer) == newest


def test_kept_curves_are_named_by_their_moves(own, monkeypatch):
    own.ask(do="keep")
    own.ask(do="design", number=1, values={"delay": 2.5})
    own.wait("answer", is_whole(1))
    own.ask(do="keep", again=1)
    names = [entry["name"] for entry in json.loads(own.exchange.answer)["legend"]]
    assert names == ["Kalman", "Kalman, kept", "Kalman, total delay 2.5 frames"]
    own.ask(do="drop", name=names[1])
    assert [e["name"] for e in json.loads(own.exchange.answer)["legend"]] == [names[0], names[2]]
    monkeypatch.setattr(server, "_MOST_KEPT", 1)
    own.ask(do="design", number=2, values={"gain": 0.5})
    own.wait("answer", is_whole(2))
    own.ask(do="keep", again=2)
    names = [entry["name"] for entry in json.loads(own.exchange.answer)["legend"]]
    assert names == ["Kalman", "Kalman, real sensor gain 0.5"]


def test_a_save_that_fails_is_said(own, tmp_path):
    own.ask(do="save")
    saved = json.loads(own.exchange.saved)
    assert Path(saved["files"][0]).name == "explored-1.yaml"
    assert len(own.session._saved) == 3
    own.session._folder = tmp_path / "nowhere"
    own.ask(do="save", again=1)
    assert "cannot write" in json.loads(own.exchange.saved)["error"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("explore")


@pytest.fixture(scope="module")
def address(folder):
    config = lbt.load_config(write_config(folder, five_lines()))
    lbt.save_gain(folder / "old.fits", lbt.integrator(config.hardware, gain=0.3))
    with served(folder / "c.yaml", folder / "old.fits", folder=folder) as found:
        yield found


@pytest.fixture(scope="module")
def simple(folder):
    with served(LBT_YAML, folder=folder) as found:
        yield found


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    pytest.importorskip("selenium")
    driver = chromium(tmp_path_factory.mktemp("profile"), "localhost")
    yield driver
    driver.quit()


@pytest.fixture
def page(driver, address):
    """The page as it opens, at a desk; nothing may be wrong in its console at the end."""
    show(driver, address, DESK)
    yield driver
    said = [entry for entry in driver.get_log("browser") if entry["level"] != "INFO"]
    assert said == []


def show(driver, address, screen):
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    driver.get_log("browser")
    driver.get_log("performance")
    driver.get(address)
    await_state(driver, "judged", 0)


def visible_sliders(page):
    script = "return [...document.querySelectorAll('.knob:not([hidden]) input')].map(e => e.id)"
    return page.execute_script(script)


def await_true(found):
    end = time.monotonic() + 30
    while not found():
        assert time.monotonic() < end
        time.sleep(0.05)


def await_rows(page, count):
    await_true(lambda: len(page.find_elements("css selector", "#facts tbody tr")) == count)


def verdict(page):
    return page.find_element("id", "verdict").text


@pytest.mark.browser
def test_every_slider_moves_curves(page):
    changed = set()
    keys = visible_sliders(page)
    assert len(keys) == 8
    for key in keys:
        before, said = page.execute_script(CURVES), verdict(page)
        move(page, key, 0.1 if key == "spread" else 0.62, final=True)
        await_state(page, "judged", asked(page))
        after = page.execute_script(CURVES)
        moved = {name for name in after if after[name] != before[name]}
        assert moved, key
        assert verdict(page) != said, key
        changed |= moved
        reset(page)
        assert page.execute_script(CURVES) == before, key
    assert changed == set(after)


@pytest.mark.browser
def test_sliders_follow_the_method(page):
    before = set(visible_sliders(page))
    choose(page, "hinf")
    (own,) = set(visible_sliders(page)) - before
    curves = page.execute_script(CURVES)
    move(page, own, 0.3, final=True)
    assert page.execute_script(CURVES) != curves


@pytest.mark.browser
def test_the_page_lives_while_a_slow_design_runs(page, simple):
    show(page, simple, DESK)
    select(page, "robust")
    await_true(page.find_element("id", "busy").is_displayed)
    assert "robust-modulus_margin" in visible_sliders(page)
    select(page, "kalman")
    await_state(page, "judged", 2)
    assert "Kalman" in verdict(page)
    assert not page.find_element("id", "busy").is_displayed()


@pytest.mark.browser
def test_kept_curves_stay_beside(page):
    rows = "#facts tbody tr"
    assert [row.text.split()[0] for row in page.find_elements("css selector", rows)] == [
        "Kalman",
        "old",
    ]
    move(page, "gain", 0.5, final=True)
    page.find_element("id", "keep").click()
    await_rows(page, 3)
    move(page, "gain", 0.2, final=True)
    texts = [row.text for row in page.find_elements("css selector", rows)]
    assert texts[2].startswith("Kalman, real sensor gain 1.35")
    assert texts[2].split()[-3:] != texts[0].split()[-3:]
    page.find_element("css selector", "#facts button").click()
    await_rows(page, 2)


@pytest.mark.browser
def test_files_are_saved(page, folder):
    move(page, "delay", 0.3, final=True)
    page.find_element("id", "save").click()
    box = page.find_element("id", "saved")
    await_true(lambda: box.text)
    assert "lbt-synth design explored-1.yaml --method kalman" in box.text
    saved = lbt.load_config(folder / "explored-1.yaml")
    assert saved.hardware.delay_frames == 2.5
    assert lbt.load_gain(folder / "explored-1.fits").certificate.passed


@pytest.mark.browser
def test_what_cannot_be_designed_is_said(page):
    page.execute_script("document.getElementById('method').add(new Option('another', 'kalmann'));")
    said = page.find_element("id", "error")
    for method, words in (("kalmann", "Did you mean kalman"), ("kalman", "")):
        page.execute_script(
            "const list = document.getElementById('method'); list.value = arguments[0];"
            "list.dispatchEvent(new Event('input')); list.dispatchEvent(new Event('change'));",
            method,
        )
        for _ in range(100):
            if words in said.text and bool(words) == bool(said.text):
                break
            time.sleep(0.1)
        assert words in said.text
        assert bool(words) == bool(said.text)


@pytest.mark.browser
def test_the_keyboard_moves_sliders(page):
    keys, focused = chain(page), "return document.activeElement.id"
    for _ in range(40):
        keys.send_keys("\ue004").perform()
        if page.execute_script(focused) == "gain":
            break
    assert page.execute_script(focused) == "gain"
    text = page.find_element("id", "gain").get_attribute("aria-valuetext")
    keys.send_keys("\ue014").perform()  # to the right
    await_state(page, "judged", asked(page))
    assert page.find_element("id", "gain").get_attribute("aria-valuetext") != text


@pytest.mark.browser
def test_everything_has_a_name_for_those_who_listen(page):
    page.execute_cdp_cmd("Accessibility.enable", {})
    nodes = page.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    named = {
        role: [node["name"]["value"] for node in nodes if node.get("role", {}).get("value") == role]
        for role in ("slider", "combobox", "button", "image", "status")
    }
    assert "measurement noise" in named["slider"]
    assert named["combobox"] == ["Method"]
    assert {"Keep", "Save", "Reset"} <= set(named["button"])
    assert all(named["slider"])
    assert len(named["slider"]) == 8
    live = page.find_element("id", "verdict")
    assert live.get_attribute("aria-live") == "polite"
    assert live.get_attribute("role") == "status"


@pytest.mark.browser
def test_it_fits_a_phone(page, address):
    show(page, address, {**PHONE, "width": 390})
    sizes = page.execute_script(
        "return [document.documentElement.scrollWidth, innerWidth,"
        " ...[...document.querySelectorAll('.plot')].map(e => e.getBoundingClientRect().width)]"
    )
    assert sizes[0] <= 390
    assert min(sizes[2:]) > 250
    assert page.find_element("id", "delay").is_displayed()


@pytest.mark.browser
def test_nothing_is_asked_from_elsewhere(page, address):
    asked_for = {
        found
        for entry in page.get_log("performance")
        if '"Network.requestWillBeSent"' in entry["message"]
        for found in re.findall(r'"url":"([^"]*)"', entry["message"])
    }
    assert asked_for
    assert all(url.startswith((address, "data:", "blob:")) for url in asked_for)


@pytest.mark.browser
def test_another_origin_is_refused(driver, address):
    driver.get("data:text/html,<title>elsewhere</title>")
    script = (
        "const [url, done] = arguments, socket = new WebSocket(url, ['bokeh', 'x']);"
        "socket.onopen = () => done('open'); socket.onerror = () => done('refused');"
    )
    assert driver.execute_async_script(script, address.replace("http", "ws") + "ws") == "refused"
    driver.get_log("browser")


def test_newer_work_replaces_what_waits():
    lane, began, go_on, ended = Lane(), Event(), Event(), Event()
    done = []

    def first():
        began.set()
        assert go_on.wait(10)
        done.append((1, lane.is_waiting))

    lane.submit(first)
    assert began.wait(10)
    assert not lane.is_waiting
    lane.submit(lambda: done.append((2, None)))
    lane.submit(lambda: (done.append((3, lane.is_waiting)), ended.set()))
    go_on.set()
    assert ended.wait(10)
    assert done == [(1, True), (3, False)]
    lane.close()


def test_a_closed_lane_drops_what_waits():
    lane, began, go_on = Lane(), Event(), Event()
    lane.submit(lambda: (began.set(), go_on.wait(10)))
    assert began.wait(10)
    lane.submit(lambda: began.clear())
    lane.close()
    go_on.set()
    lane._thread.join(10)
    assert not lane._thread.is_alive()
    assert began.is_set()


def test_work_is_shown_in_the_unit_of_the_page():
    shown, ended = [], Event()
    with own_display_unit():
        show_in("mas", 10.0)
        lane = Lane()
    lane.submit(lambda: (shown.append(nm_text(20.0)), ended.set()))
    assert ended.wait(10)
    assert shown == ["2 mas"]
    lane.close()


@pytest.mark.parametrize("method", ["kalman", "hinf"])
def test_the_commands_make_the_files(exploration, tmp_path, monkeypatch, capsys, method):
    wish = method, {"delay": 2.5, "shift": 0.7, f"{method}-gamma_ratio": 1.4}
    view = quick_view(exploration, *wish)
    (config, gain, script), commands = save_view(exploration, view, tmp_path)
    assert lbt.load_config(config).text == view.config.text
    kept = lbt.load_gain(gain)
    np.testing.assert_array_equal(kept.gain_predictor, view.design.gain_predictor)
    gain.unlink()
    monkeypatch.chdir(tmp_path)
    words = commands[0].split()
    assert words[0] == "lbt-synth"
    assert commands[0] in script.read_text().splitlines()
    status, _, error = run(capsys, *words[1:])
    assert (status, error) == (0, "")
    made = lbt.load_gain(gain)
    np.testing.assert_allclose(made.gain_predictor, kept.gain_predictor, rtol=1e-9, atol=1e-12)


def test_nothing_is_overwritten(exploration, tmp_path):
    view = quick_view(exploration, "kalman")
    first = save_view(exploration, view, tmp_path)
    (tmp_path / "explored-2.sh").write_text("mine")
    third = save_view(exploration, view, tmp_path)
    assert [path.name for path in first[0]] == [f"explored-1.{e}" for e in ("yaml", "fits", "sh")]
    assert [path.name for path in third[0]] == [f"explored-3.{e}" for e in ("yaml", "fits", "sh")]
    assert (tmp_path / "explored-2.sh").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 7


def test_the_head_says_what_was_moved(exploration, tmp_path):
    view = quick_view(exploration, "kalman", {"gain": 0.5})
    config = save_view(exploration, view, tmp_path)[0][0]
    head = config.read_text().splitlines()[:2]
    assert head[0].startswith("# 'lbt.yaml' with real sensor gain 0.5; lbt_synth ")
    assert head[1] == "# lbt-synth design explored-1.yaml --method kalman -o explored-1.fits"


LOOKS = {"Kalman": 0, "old": 1}


@pytest.fixture(scope="module")
def view():
    config = lbt.load_config("examples/lbt.yaml")
    exploration = explore(config, {"old": lbt.integrator(config.hardware, gain=0.3)})
    return whole_view(exploration, quick_view(exploration, values={"shift": 1.0}))


@pytest.fixture(scope="module")
def numbers(view):
    found = explore_numbers(view.shown, view.config.truth.lines_hz, view.shift_hz)
    return {key.removeprefix("explore-"): value for key, value in found.items()}


def test_every_design_is_in_every_figure_that_it_has(numbers):
    for key, (curves, _, _) in numbers.items():
        assert set(curves) == ({"Kalman"} if key == "sigma" else {"Kalman", "old"}), key


def test_rules_mark_the_lines_and_the_slider(numbers):
    assert list(numbers["noise"][1]) == [21.0]
    assert list(numbers["strehl"][1]) == [1.0]


def test_the_strehl_scale_is_that_of_what_is_there(numbers):
    curves, _, (_, (low, _)) = numbers["strehl"]
    least = min(float(np.min(y)) for _, y in curves.values())
    assert least > 15
    assert least - 15 < low <= least


def test_scales_end_at_decades(numbers):
    for key, decades in (("rejection", 4), ("noise", 2), ("spectrum", 4), ("sigma", 2)):
        curves, _, (_, (low, high)) = numbers[key]
        highest = max(float(np.max(y)) for _, y in curves.values())
        assert highest < high < 12 * max(highest, 1.0)
        assert low == pytest.approx(high / 10**decades)
        assert np.log10(high) == pytest.approx(round(np.log10(high)))


def test_an_unstable_loop_has_scales(view):
    nothing = np.full(3, np.nan)
    lost = {name: np.full(one.frequency_hz.size, np.nan) for name, one in view.shown.items()}
    shown = {
        name: replace(one, rejection=lost[name], shift_hz=np.arange(3.0), strehls=nothing)
        for name, one in view.shown.items()
    }
    for _, _, ends in explore_numbers(shown, (), 0.0).values():
        assert np.isfinite(ends).all()
        assert all(low < high for low, high in ends)


def test_the_plane_of_the_loop_gain_stays_small(numbers):
    curves, _, ends = numbers["nyquist"]
    x, _ = curves["Kalman"]
    assert np.nanmax(np.abs(x)) <= 9.0
    assert np.isnan(x).sum() == 2  # after each of two measurements
    assert ends == ((-4.0, 2.0), (-3.0, 3.0))


def figure_of(live):
    ((figure, _, _),) = live.root.children
    return figure


def numbers_of(heights, *, at=2.0, high=10.0):
    x = np.arange(1.0, 1.0 + len(heights))
    return {"Kalman": (x, np.array(heights))}, [at], ((1.0, 4.0), (0.1, high))


def test_new_numbers_go_to_the_same_figure():
    live = LivePanel("explore-noise")
    live.show(numbers_of([1.0, 2.0, -1.0]), LOOKS)
    figure = figure_of(live)
    rule, line = figure.renderers[0].data_source, figure.renderers[1].data_source
    np.testing.assert_array_equal(line.data["y0"], [1.0, 2.0, np.nan])  # none on this scale
    live.show(numbers_of([3.0, 4.0, 5.0, 6.0], at=3.0), LOOKS)
    assert figure_of(live) is figure
    np.testing.assert_array_equal(line.data["y0"], [3.0, 4.0, 5.0, 6.0])
    np.testing.assert_array_equal(rule.data["at"], [3.0])


def test_what_is_the_same_is_not_sent():
    live, sent = LivePanel("explore-noise"), []
    live.show(numbers_of([1.0, 2.0]), LOOKS)
    for renderer in figure_of(live).renderers[:2]:
        renderer.data_source.on_change("data", lambda attr, old, new: sent.append(1))
    live.show(numbers_of([1.0, 2.0], at=3.0), LOOKS)
    assert sent == [1]


def test_scales_follow():
    live = LivePanel("explore-noise")
    live.show(numbers_of([1.0, 2.0]), LOOKS)
    figure = figure_of(live)
    live.show(numbers_of([1.0, 2.0], high=100.0), LOOKS)
    assert figure_of(live) is figure
    assert (figure.y_range.start, figure.y_range.end) == (0.1, 100.0)


def test_other_designs_make_another_figure():
    live, shown = LivePanel("explore-noise"), numbers_of([1.0, 2.0])
    live.show(shown, LOOKS)
    figure = figure_of(live)
    live.show(shown, {"Kalman": 1})
    assert figure_of(live) is not figure
    live.show(({**shown[0], "old": shown[0]["Kalman"]}, *shown[1:]), LOOKS)
    lines = figure_of(live).renderers[1:]
    assert [one.name for one in lines] == ["design Kalman", "design old"]
    assert lines[0].data_source is lines[1].data_source  # sent once
