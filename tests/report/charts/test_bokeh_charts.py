"""Charts for the screen: their data, and the same scales as on paper."""

import json
import re
import time
from dataclasses import replace

import numpy as np
import pytest
from support.browser import DESK, PHONE, WALK, chain, drawn_plots, opened, tooltips
from support.pages import every_mark

from lbt_synth.report.charts.bokeh_charts import LivePanel, embed_charts
from lbt_synth.report.charts.description import Axis, Chart, Curve, Panel, Rule
from lbt_synth.report.charts.matplotlib_charts import draw_figure
from lbt_synth.report.charts.scales import legend_entries


def test_the_data_of_charts_are_those_given():
    chart = every_mark()[0]
    embedding, lines = embed_charts([chart])
    numbers = json.dumps(embedding)
    assert set(lines["lines"]) == set(legend_entries(chart.panels)) - {"only named"}
    for identifiers in lines["lines"].values():
        for identifier in identifiers:
            assert numbers.count(f'"{identifier}"') >= 1
    assert len(lines["lines"]["first"]) == 2  # once a panel
    places = embedding["items"][0]["roots"].values()
    assert list(places) == ["lines_panel-1", "lines_panel-2"]
    assert '"x": "p' not in numbers


def test_both_renderers_leave_the_same_room():
    curve = Curve(name="a", x=[0.0, 1.0, 2.0], y=[0.0, 99.0, 100.0], marker="own")
    panel = Panel(x=Axis(label="x"), y=Axis(label="y", low=0.0), marks=(curve,))
    chart = Chart(key="room", title="t", caption="c", alt="a", panels=(panel,))
    data = embed_charts([chart])[0]["documents"]["page"]["roots"][0]["attributes"]
    ends = data["y_range"]["attributes"]
    assert (ends["start"], ends["end"]) == pytest.approx((-4.0, 104.0))
    figure = draw_figure(chart.panels)
    assert figure.axes[0].get_ylim() == pytest.approx((-4.0, 104.0))


@pytest.mark.browser
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


@pytest.mark.browser
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


@pytest.mark.browser
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


@pytest.mark.browser
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


@pytest.mark.browser
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


@pytest.mark.browser
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


def panel(heights, *, look=0, at=2.0, high=10.0):
    x = np.arange(1.0, 1.0 + len(heights))
    curve = Curve(name="a", x=x, y=np.array(heights), look=look)
    axes = {"x": Axis(label="x"), "y": Axis(label="y", log=True, low=0.1, high=high)}
    return Panel(**axes, marks=(curve, Rule(name="now", at=at)))


def figure_of(live):
    ((figure, _, _),) = live.root.children
    return figure


def test_new_numbers_go_to_the_same_figure():
    live = LivePanel("key")
    live.show(panel([1.0, 2.0, -1.0]))
    figure = figure_of(live)
    line, rule = figure.renderers[0].data_source, figure.renderers[1].data_source
    np.testing.assert_array_equal(line.data["y0"], [1.0, 2.0, np.nan])  # none on this scale
    live.show(panel([3.0, 4.0, 5.0, 6.0], at=3.0))
    assert figure_of(live) is figure
    np.testing.assert_array_equal(line.data["y0"], [3.0, 4.0, 5.0, 6.0])
    np.testing.assert_array_equal(rule.data["at"], [3.0])


def test_what_is_the_same_is_not_sent():
    live, sent = LivePanel("key"), []
    live.show(panel([1.0, 2.0]))
    for renderer in figure_of(live).renderers[:2]:
        renderer.data_source.on_change("data", lambda attr, old, new: sent.append(1))
    live.show(panel([1.0, 2.0], at=3.0))
    assert sent == [1]


def test_scales_follow():
    live = LivePanel("key")
    live.show(panel([1.0, 2.0]))
    figure = figure_of(live)
    live.show(panel([1.0, 2.0], high=100.0))
    assert figure_of(live) is figure
    assert (figure.y_range.start, figure.y_range.end) == pytest.approx((0.1, 100.0))
    assert max(figure.yaxis[0].ticker.ticks) == pytest.approx(100.0)


def test_other_marks_make_another_figure():
    live, shown = LivePanel("key"), panel([1.0, 2.0])
    live.show(shown)
    figure = figure_of(live)
    live.show(panel([1.0, 2.0], look=1))
    assert figure_of(live) is not figure
    live.show(replace(shown, marks=(*shown.marks, Rule(name="", at=1.0, axis="y"))))
    assert len(figure_of(live).renderers) == 4
