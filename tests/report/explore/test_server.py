"""The page of sliders: what a session does, and how it looks in Chromium."""

import re
from dataclasses import replace
from queue import Queue

import numpy as np
import pytest
from bokeh.document import Document
from support.browser import DESK, chromium
from support.commands import run
from support.configs import write_config
from support.explore import (
    await_true,
    await_verdict,
    five_lines,
    move,
    press,
    served,
    text_of,
)
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.report.explore import server
from lbt_synth.report.explore.exploration import explore, new_view
from lbt_synth.report.explore.server import (
    LivePanel,
    Session,
    figure_ends,
    knob_slider,
    save_view,
    table_html,
)
from lbt_synth.storage.display_unit import own_display_unit, show_in

FIGURES = """
const figures = {};
for (const name of arguments[0]) {
  const figure = Bokeh.documents[0].get_model_by_name(name);
  figures[name] = JSON.stringify(figure.renderers.map(
    (one) => Object.entries(one.data_source.data).map(([name, column]) => [name, [...column]])));
}
return figures;
"""


class Page:
    """A document whose callbacks run when the test says so."""

    def __init__(self, *arguments):
        self.document, self._later = Document(), Queue()
        self.document.add_next_tick_callback = self._later.put
        self.session = Session(self.document, *arguments, [])

    def __getitem__(self, name):
        return self.document.get_model_by_name(name)

    def verdict(self):
        """Run what is to be done on the document until there is a verdict."""
        while self["verdict"].text in ("", "Designing …"):
            self._later.get(timeout=30)()
        return self["verdict"].text

    def move(self, **values):
        for key, value in values.items():
            self[key].value = value
            self.release(key)
        return self.verdict()

    def release(self, key):
        """Let go of a slider, as only a browser can."""
        slider = self[key]
        slider.trigger("value_throttled", None, slider.value)

    def names(self):
        return re.findall("</svg> ([^<]*)<", self["facts"].text)


@pytest.fixture(scope="module")
def exploration():
    return explore(lbt.load_config(LBT_YAML), {})


@pytest.fixture(scope="module")
def first(exploration):
    return new_view(exploration)


@pytest.fixture
def own(exploration, first, tmp_path):
    page = Page(exploration, first, tmp_path)
    page.verdict()
    yield page
    page.session._close(None)


def test_a_slider_that_moves_is_a_new_design(own):
    facts = own["facts"].text
    said = own.move(delay=3.0)
    assert own["facts"].text != facts
    residual = re.search(r"<td align='right'>([\d.]+)</td>", own["facts"].text)[1]
    assert f"leaves {residual} nm rms" in said
    assert own.session._view.config.hardware.delay_frames == 3.0


def test_an_error_is_said_and_the_curves_stay(own, monkeypatch):
    facts = own["facts"].text
    monkeypatch.setattr(server, "new_view", lambda *_: 1 / 0)
    assert own.move(delay=3.0) == "division by zero"
    assert own["facts"].text == facts


def test_results_that_come_late_are_not_shown(own, first):
    own.move(gain=0.5)
    facts, said = own["facts"].text, own["verdict"].text
    own.session._show(0, first)
    own.session._say(0, "late")
    assert (own["facts"].text, own["verdict"].text) == (facts, said)


def test_a_slow_method_waits_for_the_release(own):
    own.session._seconds["kalman"] = 5.0
    own["gain"].value = 0.5
    assert own["verdict"].text != "Designing …"
    own.release("gain")
    assert own["verdict"].text == "Designing …"


def test_sliders_follow_the_method(own):
    assert own["damping"].visible
    assert not own["gamma_ratio"].visible
    own["method"].value = "hinf"
    assert own["gamma_ratio"].visible
    own["method"].value = "integrator"
    assert not own["damping"].visible


def test_kept_curves_are_named_by_their_moves(own):
    own.session._keep()
    own.move(delay=2.5)
    own.session._keep()
    assert own.names() == ["Kalman", "Kalman, kept", "Kalman, total delay 2.5 frames"]
    own.move(delay=2.0, gain=0.5)
    own.session._keep()
    assert own.names()[2:] == ["Kalman, total delay 2.5 frames", "Kalman, real sensor gain 0.5"]
    own.session._reset()
    own.verdict()
    assert own.names() == ["Kalman"]
    assert own.session._view.moves == ""


def test_a_save_that_fails_is_said(own, tmp_path):
    own.session._save()
    assert "explored-1.yaml" in own["saved"].text
    assert len(own.session._saved) == 2
    own.session._folder = tmp_path / "nowhere"
    own.session._save()
    assert "cannot write" in own["saved"].text


def test_a_slider_shows_the_unit_of_the_page(exploration):
    noise = next(knob for knob in exploration.knobs if knob.key == "noise")
    with own_display_unit():
        show_in("mas", 10.0)
        slider = knob_slider(noise)
    assert slider.format.args == {"factor": 0.1, "log": True, "unit": "mas"}
    assert slider.start < slider.value < slider.end
    assert 10**slider.value == pytest.approx(noise.value)


def test_hostile_names_stay_names(first):
    text = table_html({"<b>&'": next(iter(first.shown.values()))})
    assert "<b>" not in text
    assert "&lt;b&gt;&amp;&#x27;" in text


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
    await_verdict(driver)


KEYS = ("delay", "gain", "noise", "shift", "seeing", "wind", "damping", "spread")


@pytest.mark.browser
def test_every_slider_moves_curves(page):
    changed = set()
    for key in KEYS:
        before, said = page.execute_script(FIGURES, list(server.FIGURES)), text_of(page, "verdict")
        assert move(page, key, 0.1 if key == "spread" else 0.62) != said, key
        after = page.execute_script(FIGURES, list(server.FIGURES))
        moved = {name for name in after if after[name] != before[name]}
        assert moved, key
        changed |= moved
        press(page, "reset")
        await_true(lambda: text_of(page, "verdict") == said)  # noqa: B023  # of this turn
        assert page.execute_script(FIGURES, list(server.FIGURES)) == before, key
    assert changed == set(after)


@pytest.mark.browser
def test_another_origin_is_refused(driver, address):
    driver.get("data:text/html,<title>elsewhere</title>")
    script = (
        "const [url, done] = arguments, socket = new WebSocket(url, ['bokeh', 'x']);"
        "socket.onopen = () => done('open'); socket.onerror = () => done('refused');"
    )
    assert driver.execute_async_script(script, address.replace("http", "ws") + "ws") == "refused"
    driver.get_log("browser")


@pytest.mark.parametrize("method", ["kalman", "hinf"])
def test_the_commands_make_the_files(exploration, tmp_path, monkeypatch, capsys, method):
    wish = method, {"delay": 2.5, "shift": 0.7, "gamma_ratio": 1.4}
    view = new_view(exploration, *wish)
    (config, gain), commands = save_view(exploration, view, tmp_path)
    assert lbt.load_config(config).text == view.config.text
    head = config.read_text().splitlines()[:2]
    assert head[0].startswith("# 'lbt.yaml' with total delay 2.5 frames, frequency error")
    assert head[1] == f"# {commands[0]}"
    kept = lbt.load_gain(gain)
    np.testing.assert_array_equal(kept.gain_predictor, view.design.gain_predictor)
    gain.unlink()
    monkeypatch.chdir(tmp_path)
    words = commands[0].split()
    assert words[0] == "lbt-synth"
    status, _, error = run(capsys, *words[1:])
    assert (status, error) == (0, "")
    made = lbt.load_gain(gain)
    np.testing.assert_allclose(made.gain_predictor, kept.gain_predictor, rtol=1e-9, atol=1e-12)


def test_nothing_is_overwritten(exploration, first, tmp_path):
    one, _ = save_view(exploration, first, tmp_path)
    (tmp_path / "explored-2.fits").write_text("mine")
    third, _ = save_view(exploration, first, tmp_path)
    assert [path.name for path in one] == ["explored-1.yaml", "explored-1.fits"]
    assert [path.name for path in third] == ["explored-3.yaml", "explored-3.fits"]
    assert (tmp_path / "explored-2.fits").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 5


@pytest.fixture(scope="module")
def shown():
    config = lbt.load_config("examples/lbt.yaml")
    exploration = explore(config, {"old": lbt.integrator(config.hardware, gain=0.3)})
    return new_view(exploration, values={"shift": 1.0}).shown


def curves_of(key, shown):
    return {name: one.curves[key] for name, one in shown.items() if key in one.curves}


def test_scales_move_in_steps_around_what_is_there(shown):
    for key in ("rejection", "noise", "spectrum", "sigma"):
        curves = curves_of(f"explore-{key}", shown)
        _, (low, high) = figure_ends(f"explore-{key}", curves)
        highest = max(float(np.max(y)) for _, y in curves.values())
        assert highest < high < 12 * max(highest, 1.0)
        assert low == pytest.approx(high / 1e4)
        assert np.log10(high) == pytest.approx(round(np.log10(high)))
    curves = curves_of("explore-strehl", shown)
    _, (low, _) = figure_ends("explore-strehl", curves)
    assert -15 < low - min(float(np.min(y)) for _, y in curves.values()) <= 0


@pytest.mark.parametrize("key", server.FIGURES)
def test_an_unstable_loop_has_scales(shown, key):
    curves = {name: (x, np.full(x.size, np.nan)) for name, (x, _) in curves_of(key, shown).items()}
    ends = figure_ends(key, curves)
    assert np.isfinite(ends).all()
    assert all(low < high for low, high in ends)


def test_new_numbers_go_to_the_same_figure(shown):
    panel = LivePanel("explore-noise")
    x = np.array([1.0, 2.0, 4.0])
    odd = replace(shown["Kalman"], curves={"explore-noise": (x, np.array([1.0, 2.0, -1.0]))})
    panel.show({"Kalman": odd}, [2.0])
    assert panel.curves.data["name"] == ["Kalman"]
    np.testing.assert_array_equal(panel.curves.data["y"][0], [1.0, 2.0, np.nan])  # logarithmic
    panel.show({"Kalman": odd, "old": odd}, [3.0])
    assert panel.curves.data["name"] == ["Kalman", "old"]
    assert len(set(panel.curves.data["colour"])) == len(set(panel.curves.data["look"])) == 2
    np.testing.assert_array_equal(panel.rules.data["at"], [3.0])
    assert (panel.figure.x_range.start, panel.figure.y_range.end) == (1.0, 10.0)


def test_poles_are_points_with_the_marker_of_their_design(shown):
    poles = {"Kalman": np.array([0.1, 0.2]), "old": np.array([0.3])}
    designs = {
        name: replace(shown["old"], curves={"explore-poles": (x, 0 * x)})
        for name, x in poles.items()
    }
    panel = LivePanel("explore-poles")
    panel.show(designs, ())
    assert list(panel.curves.data["look"]) == ["circle", "circle", "square"]
    assert list(panel.curves.data["x"]) == [0.1, 0.2, 0.3]
