"""The page of sliders: what moves, what follows, what a session does, and Chromium."""

import re
from queue import Queue

import numpy as np
import pytest
from bokeh.document import Document
from support.browser import DESK, chromium
from support.commands import run
from support.configs import AR, change_key, write_config
from support.explore import await_true, await_verdict, five_lines, press, served, text_of
from support.explore import move as move_slider
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.report import explore
from lbt_synth.report.explore import (
    FIGURES,
    Session,
    explored_table,
    judge,
    list_knobs,
    move,
    new_view,
    save_view,
    whole_view,
)
from lbt_synth.report.figures.records import exact_spectrum
from lbt_synth.storage.display_unit import own_display_unit, show_in


@pytest.fixture(scope="module")
def start(config):
    return config


@pytest.fixture(scope="module")
def old(start):
    return {"old": lbt.integrator(start.hardware, gain=0.3)}


@pytest.fixture(scope="module")
def first(start, old):
    return whole_view(new_view(start, old), start)


def test_a_view_begins_with_its_own_design(start, first):
    assert (first.name, first.moves) == ("Kalman", "")
    assert [row[0] for row in explored_table(first.shown).rows] == ["Kalman", "old"]
    again = new_view(start, {"Kalman": first.design})
    assert list(again.shown) == ["Kalman by the sliders", "Kalman"]


def test_the_verdict(start, first):
    loop = lbt.close_loop(first.config.hardware, first.design.controller)
    budget = lbt.residual_budget(loop, first.config.truth)
    text = judge(first)
    assert text.startswith(f"Kalman leaves {budget.rms_nm:.1f} nm rms in the truth (Strehl ratio")
    assert "above the 37.8 nm of the best linear one. It survives 0.47 frames" in text
    certified = f"Certified: {len(first.design.certificate.checks)} checks passed."
    assert text.endswith(certified)
    unstable = judge(new_view(start, {}, "kalman", {"gain": 2.4}))
    ends = lbt.loop.stable_sensor_gains(start.hardware, first.design.controller)
    words = "Kalman is stable at sensor gains of {:.4g} to {:.4g}; at 2.4 this loop is UNSTABLE."
    assert unstable == words.format(*ends)
    assert judge(new_view(start, {}, "hinf", {"gain": 0.6})).startswith("WARNING: 0.0")


def test_moves_in_words_and_in_the_unit_that_is_shown(start):
    view = new_view(start, {}, "hinf", {"delay": 2.5, "gamma_ratio": 1.7})
    assert view.moves == "total delay 2.5 frames, gamma ratio of hinf, mixed 1.7"
    assert view.design.gamma_requested == pytest.approx(1.7 * view.design.gamma_least, rel=1e-6)
    with own_display_unit():
        show_in("mas", 10.0)
        view = new_view(start, {}, "kalman", {"noise": 20.0})
        assert view.moves == "measurement noise 2 mas"
        assert " mas rms in the truth" in judge(view)


def test_curves_are_those_of_the_loop(start, first):
    design, curves = first.design, first.shown["Kalman"].curves
    loop = lbt.close_loop(start.hardware, design.controller)
    grid = curves["Rejection"][0]
    noise = loop.path("noise", "residual").frequency_response(grid)
    for title, values in (
        ("Rejection", spectral_norms(loop.sensitivity(grid))),
        ("Noise", spectral_norms(noise)),
        ("Estimation error", spectral_norms(design.error_system().frequency_response(grid))),
        ("Residual spectrum", exact_spectrum(loop, start.truth, grid, 2048)),
    ):
        np.testing.assert_allclose(curves[title][1], values)
    assert "Estimation error" not in first.shown["old"].curves


def test_performance_is_that_of_the_budget(start, first):
    shift = 1.3
    view = whole_view(new_view(start, {}, "", {"shift": shift, "gain": 0.8}), start)
    shown, config = view.shown["Kalman"], view.config
    loop = lbt.close_loop(config.hardware, first.design.controller, sensor_gain=0.8)
    budget = lbt.residual_budget(loop, config.truth)
    assert shown.residual_nm == pytest.approx(budget.rms_nm, rel=1e-6)
    assert shown.strehl == pytest.approx(lbt.strehl(budget, config.imaging), rel=1e-6)
    still = lbt.residual_budget(loop, move(start, {"gain": 0.8}).truth)
    shifts, percents = shown.curves["Strehl ratio"]
    expected = 100 * lbt.strehl(still, config.imaging)
    assert float(percents[shifts == 0][0]) == pytest.approx(expected, rel=1e-6)
    assert (shifts[0], shifts[-1]) == (-3.5, 3.5)


def test_an_unstable_loop_has_no_numbers(start):
    shown = whole_view(new_view(start, {}, "", {"gain": 2.4}), start).shown["Kalman"]
    titles = ("Rejection", "Noise", "Residual spectrum", "Strehl ratio")
    curves = [shown.curves[title][1] for title in titles]
    assert np.isnan([shown.residual_nm, shown.strehl, *np.concatenate(curves)]).all()


@pytest.fixture(scope="module")
def five(tmp_path_factory):
    return lbt.load_config(write_config(tmp_path_factory.mktemp("five"), five_lines()))


def frequencies(lines):
    return [line.frequency_hz for line in lines]


def test_the_knobs_of_a_configuration(tmp_path, start, five):
    knobs = list_knobs(five)
    loop = ["delay", "gain", "noise", "shift", "seeing", "wind"]
    assert [knob.key for knob in knobs] == [*loop, "damping", "gamma_ratio"]
    assert all(knob.low <= knob.value <= knob.high for knob in knobs)
    before = start.text
    assert move(start, {"delay": 99.0, "shift": -9.0}).hardware.delay_frames == 6.0
    assert start.text == before
    content = change_key(("truth", "vibrations"), [])
    del content["model"]["vibrations"], content["atmosphere"], content["end_to_end"]
    content["model"]["turbulence"] = {"kind": "ar", "coefficients": [0.99], "driving_rms_nm": 9.0}
    content["truth"]["turbulence"] = "model"
    config = lbt.load_config(write_config(tmp_path, content))
    assert [knob.key for knob in list_knobs(config)] == ["delay", "gain", "noise", "gamma_ratio"]


@pytest.mark.parametrize("example", ["lbt.yaml", "lbt_robust.yaml", "lbt_slow_mirror.yaml"])
def test_a_knob_at_its_value_changes_nothing(example):
    config = lbt.load_config(ROOT / "examples" / example)
    after = move(config, {knob.key: knob.value for knob in list_knobs(config)})
    for matrix in "ABCDL":
        ours, theirs = getattr(after.plant, matrix), getattr(config.plant, matrix)
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
    assert after.hardware.delay_frames == config.hardware.delay_frames
    assert after.truth.sensor_gain == pytest.approx(config.truth.sensor_gain, rel=1e-12)
    assert after.truth.noise_nm == pytest.approx(config.truth.noise_nm, rel=1e-12)
    facts = [
        [[line.frequency_hz, line.rms_nm, *line.direction] for line in one.truth.vibrations]
        for one in (after, config)
    ]
    np.testing.assert_allclose(*facts, rtol=1e-12, atol=1e-12)


def test_a_shift_moves_the_truth_alone(tmp_path, five):
    after = move(five, {"shift": 2.5})
    assert frequencies(after.plant.vibrations) == frequencies(five.plant.vibrations)
    expected = frequencies(five.truth.with_frequency_error(2.5).vibrations)
    assert frequencies(after.truth.vibrations) == pytest.approx(expected)
    content = five_lines()
    content["model"]["vibrations"][1] |= {"frequency_error_hz": 2.0, "sections": 3}
    config = lbt.load_config(write_config(tmp_path, content))
    after = move(config, {"shift": 1.0})
    places = sorted(set(frequencies(after.truth.vibrations)))
    assert places == pytest.approx([13.0, 21.0, 33.0, 48.0, 72.5])
    assert after.truth.frequency_errors_hz == pytest.approx(config.truth.frequency_errors_hz)
    assert [line.sections for line in after.truth.vibrations] == [1, 1, 3, 3] + 6 * [1]
    damped = move(five, {"damping": 0.02})  # what is assumed leaves the truth
    assert [line.damping for line in damped.plant.vibrations] == pytest.approx([0.02] * 10)
    assert [line.damping for line in damped.truth.vibrations] == [0.005] * 10


def test_lines_that_accelerometers_see_and_values_that_no_file_holds(tmp_path, sensors_config):
    for values in ({"shift": 0.0}, {"damping": 0.02}):
        assert move(sensors_config, values).truth.motions == sensors_config.truth.motions
    quiet = write_config(tmp_path, change_key(("sensor",), {"noise_nm": 2e-3}))
    with pytest.raises(lbt.errors.ConfigError, match="noise_nm"):
        move(lbt.load_config(quiet), {"noise": 4e-4})


def test_the_loop_and_the_sky(tmp_path, five):
    after = move(five, {"delay": 3.25, "gain": 0.5, "noise": 40.0, "seeing": 1.1, "wind": 31.0})
    air = after.atmosphere
    numbers = after.hardware.delay_frames, after.truth.sensor_gain, after.noise_nm
    assert (*numbers, air.seeing_arcsec, air.wind_speed_m_s) == pytest.approx(
        (3.25, 0.5, 40.0, 1.1, 31.0)
    )
    content = change_key(("sensor",), {"noise_nm": [30.0, 40.0]})
    content["model"] |= {"turbulence": AR, "sensor_gain": 0.5}
    content["truth"] |= {"turbulence": "model", "sensor_gain": 0.25}
    config = lbt.load_config(write_config(tmp_path, content))
    after = move(config, {"noise": np.sqrt(5000.0), "gain": 0.5})
    np.testing.assert_allclose(after.noise_nm, [60.0, 80.0])  # the proportions stay
    assert after.settings.truth.sensor_gain == 0.5
    assert after.truth.sensor_gain == pytest.approx(1.0)


def test_the_commands_make_the_files(start, tmp_path, monkeypatch, capsys):
    view = new_view(start, {}, "hinf", {"delay": 2.5, "shift": 0.7, "gamma_ratio": 1.4})
    (config, gain), commands = save_view(start, view, tmp_path)
    assert lbt.load_config(config).text == view.config.text
    head = config.read_text().splitlines()[:2]
    assert head[0].startswith("# 'lbt.yaml' with total delay 2.5 frames, frequency error")
    assert head[1] == f"# {commands[0]}"
    kept = lbt.load_gain(gain)
    np.testing.assert_array_equal(kept.gain_predictor, view.design.gain_predictor)
    gain.unlink()
    monkeypatch.chdir(tmp_path)
    status, _, error = run(capsys, *commands[0].split()[1:])
    assert (status, error) == (0, "")
    made = lbt.load_gain(gain)
    np.testing.assert_allclose(made.gain_predictor, kept.gain_predictor, rtol=1e-9, atol=1e-12)


def test_nothing_is_overwritten(start, first, tmp_path):
    one, _ = save_view(start, first, tmp_path)
    (tmp_path / "explored-2.fits").write_text("mine")
    third, _ = save_view(start, first, tmp_path)
    assert [path.name for path in one] == ["explored-1.yaml", "explored-1.fits"]
    assert [path.name for path in third] == ["explored-3.yaml", "explored-3.fits"]
    assert (tmp_path / "explored-2.fits").read_text() == "mine"


class Page:
    """A document whose callbacks run when the test says so."""

    def __init__(self, start, designs, first, folder):
        self.document, self._later = Document(), Queue()
        self.document.add_timeout_callback = lambda action, _: self._later.put(action)
        self.session = Session(self.document, start, designs, first, folder, [])

    def __getitem__(self, name):
        return self.document.get_model_by_name(name)

    def move(self, **values):
        """Move sliders, and return the verdict."""
        for key, value in values.items():
            self[key].value = value
            self.release(key)
        return self.settle()

    def release(self, key):
        """Let go of a slider, as only a browser can."""
        self[key].trigger("value_throttled", None, self[key].value)

    def settle(self):
        """Do what waits."""
        while not self._later.empty():
            self._later.get()()
        return self["verdict"].text

    def names(self):
        return re.findall(r"(?m)^  (\S.*?)  +\d", self["table"].text)


@pytest.fixture
def page(start, old, first, tmp_path):
    return Page(start, old, first, tmp_path)


def test_a_slider_that_moves_is_a_new_design(page):
    assert page["verdict"].text.startswith("Kalman leaves 51.0 nm rms")
    curves = page["Rejection"].renderers[-1].data_source
    before = curves.data["y"][0]
    page["delay"].value = 3.0
    assert page.settle() == "Designing …"  # no verdict before it is released
    assert curves.data["name"] == ["Kalman", "old"]
    assert not np.array_equal(curves.data["y"][0], before)
    said = page.move(delay=3.0)
    (residual,) = re.findall(r"Kalman +([\d.]+)", page["table"].text)
    assert f"leaves {residual} nm rms" in said
    assert page.session._view.config.hardware.delay_frames == 3.0
    assert len(set(curves.data["colour"])) == len(set(map(tuple, curves.data["dash"]))) == 2


def test_strehl_ratios_and_the_table_come_last_unless_the_slider_moves_on(page):
    def shown():
        data = [page[name].renderers[-1].data_source.data["y"][0] for name in FIGURES]
        return [page["table"].text, *(str(values.tolist()) for values in data)]

    states = [shown()]
    for delay in (2.5, 3.0):  # the first is left before it is whole
        page["delay"].value = delay
        page.session._design()
        states.append(shown())
        page.release("delay")
        page.session._finish(judges=False)
        states.append(shown())
    last = [list(FIGURES).index("Strehl ratio") + 1, 0]
    for before, after in ((0, 1), (2, 3)):
        same = [i for i, old in enumerate(states[before]) if old == states[after][i]]
        assert same == sorted(last)
    assert states[1] == states[2]
    assert page.settle().startswith("Kalman leaves")
    page["gain"].value = 0.8
    page.session._keep()
    assert page.settle() == "Designing …"
    assert len(page.names()) == 3


def test_a_slow_method_waits_for_the_release_and_an_error_is_said(page, monkeypatch):
    page.session._seconds["kalman"] = 5.0
    page["gain"].value = 0.5
    assert page["verdict"].text != "Designing …"
    page.release("gain")
    assert page["verdict"].text == "Designing …"
    page.settle()
    table = page["table"].text
    monkeypatch.setattr(explore, "new_view", lambda *_: 1 / 0)
    assert page.move(delay=3.0) == "division by zero"
    assert page["table"].text == table


def test_kept_curves_are_named_by_their_moves_and_views_are_saved(page, tmp_path):
    page.session._keep()
    page.move(delay=2.5)
    page.session._keep()
    kept = ["Kalman, kept", "Kalman, total delay 2.5 frames"]
    assert page.names() == ["Kalman", "old", *kept]
    page.session._reset()
    page.settle()
    assert page.names() == ["Kalman", "old"]
    assert page.session._view.moves == ""
    page.session._save()
    assert "explored-1.yaml" in page["saved"].text
    assert len(page.session._saved) == 2
    page.session._folder = tmp_path / "nowhere"
    page.session._save()
    assert "cannot write" in page["saved"].text


def test_a_slider_shows_the_unit_of_the_page(start, old, first, tmp_path):
    with own_display_unit():
        show_in("mas", 10.0)
        page = Page(start, old, first, tmp_path)
        assert page["noise"].title == "measurement noise [mas]"
        page.move(noise=2.0)
    assert page.session._view.config.noise_nm == pytest.approx(20.0)


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    pytest.importorskip("selenium")
    driver = chromium(tmp_path_factory.mktemp("profile"), "localhost")
    yield driver
    driver.quit()


DATA = """
const data = {};
for (const name of arguments[0]) {
  const figure = Bokeh.documents[0].get_model_by_name(name);
  data[name] = JSON.stringify(figure.renderers.map(
    (one) => Object.entries(one.data_source.data).map(([name, column]) => [name, [...column]])));
}
return data;
"""


@pytest.mark.browser
def test_every_slider_moves_curves_and_no_other_origin_does(driver, tmp_path):
    config = write_config(tmp_path, five_lines())
    with served(config, folder=tmp_path) as address:
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", DESK)
        driver.get(address)
        await_verdict(driver)
        changed = set()
        for knob in list_knobs(lbt.load_config(config)):
            if knob.key == "gamma_ratio":  # of another method
                continue
            before, said = driver.execute_script(DATA, list(FIGURES)), text_of(driver, "verdict")
            assert move_slider(driver, knob.key, 0.62) != said, knob.key
            after = driver.execute_script(DATA, list(FIGURES))
            moved = {name for name in after if after[name] != before[name]}
            assert moved, knob.key
            changed |= moved
            press(driver, "reset")
            await_true(lambda said=said: text_of(driver, "verdict") == said)
            assert driver.execute_script(DATA, list(FIGURES)) == before, knob.key
        assert changed == set(FIGURES)
        assert [e for e in driver.get_log("browser") if e["level"] != "INFO"] == []
        driver.get("data:text/html,<title>elsewhere</title>")
        script = (
            "const [url, done] = arguments, socket = new WebSocket(url, ['bokeh', 'x']);"
            "socket.onopen = () => done('open'); socket.onerror = () => done('refused');"
        )
        where = address.replace("http", "ws") + "ws"
        assert driver.execute_async_script(script, where) == "refused"
