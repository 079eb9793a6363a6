"""The page of sliders: widgets and figures of Bokeh, and the server, with a session per open page.

Scales of figures move in steps, so that curves move in them; designs are made in threads.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from html import escape
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    ColumnDataSource,
    CustomJSTickFormatter,
    Div,
    HoverTool,
    PlainText,
    Range1d,
    Select,
    Slider,
)
from bokeh.plotting import figure as new_figure
from bokeh.server.server import Server

from lbt_synth.config.write import config_text
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.files import save_gain
from lbt_synth.methods.registry import METHODS
from lbt_synth.report.draw import GREY, colour, dashes
from lbt_synth.report.explore.exploration import (
    Curve,
    Exploration,
    Knob,
    Shown,
    View,
    explored_table,
    judge,
    new_view,
)
from lbt_synth.report.figures.studies import strehl_axis
from lbt_synth.report.page.html import creator_name, words
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.storage.display_unit import shown_unit

Ends = tuple[tuple[float, float], tuple[float, float]]  # of the scales of x and y
# what is on the axes of each figure, with units of wavefronts in braces; scales over frequency are
# logarithmic
FIGURES = {
    "explore-rejection": ("frequency [Hz]", "\u03c3\u0304, phase to residual [-]"),
    "explore-noise": ("frequency [Hz]", "\u03c3\u0304, noise to residual [-]"),
    "explore-nyquist": ("real part [-]", "imaginary part [-]"),
    "explore-spectrum": ("frequency [Hz]", "power spectrum [{nm²/Hz}]"),
    "explore-strehl": ("frequency error [Hz]", "Strehl ratio [%]"),
    "explore-poles": ("real part [-]", "imaginary part [-]"),
    "explore-sigma": ("frequency [Hz]", "\u03c3\u0304, disturbances to error [{nm}]"),
}
_PLANES = {
    "explore-nyquist": ((-4.0, 2.0), (-3.0, 3.0)),
    "explore-poles": ((-1.2, 1.2), (-1.2, 1.2)),
}
_MARKERS = ("circle", "square", "triangle", "diamond", "cross", "x")
_MARKS: dict[str, Any] = {"line_color": "colour", "line_width": 2}


def figure_ends(key: str, curves: Mapping[str, Curve]) -> Ends:
    """Return where the scales of a figure end; they move in steps."""
    if key in _PLANES:
        return _PLANES[key]
    x, y = (np.concatenate([curve[i] for curve in curves.values()]) for i in (0, 1))
    y = y[np.isfinite(y)]
    if key == "explore-strehl":
        low, high = strehl_axis(y)["low"], float(np.max(y, initial=0.0)) or 100.0
        return (x.min() - 1e-9, x.max() + 1e-9), (low, high + 0.04 * (high - low))
    high = float(10.0 ** np.ceil(np.log10(1.1 * np.max(y, initial=1.0))))
    return (x.min(), x.max()), (high / 1e4, high)


class LivePanel:
    """A figure with the curves of all designs, the rules across them, and what they mean."""

    def __init__(self, key: str) -> None:
        self.key, square = key, key in _PLANES
        self._is_log = FIGURES[key][0] == "frequency [Hz]"
        scale = "log" if self._is_log else "linear"
        self.figure = figure = new_figure(
            name=key,
            title=words(key)["title"],
            **({"width": 330} if square else {"sizing_mode": "stretch_width"}),
            height=330 if square else 300,
            x_axis_type=scale,
            y_axis_type=scale,
            x_range=Range1d(),
            y_range=Range1d(),
            tools="box_zoom,pan,wheel_zoom,reset",
            toolbar_location="above",
            min_border_left=64,  # figures above each other are in line
        )
        # a finger scrolls the page
        figure.toolbar.update(logo=None, active_drag=None, active_scroll=None)
        units = {unit: shown_unit(unit)[0] for unit in ("nm", "nm²/Hz")}
        for axis, text in zip((figure.xaxis[0], figure.yaxis[0]), FIGURES[key], strict=True):
            axis.axis_label = PlainText(text=text.format_map(units))
        self.rules = ColumnDataSource({"at": []})
        self.curves = ColumnDataSource({name: [] for name in ("x", "y", "name", "colour", "look")})
        figure.vspan(x="at", source=self.rules, line_color=GREY, line_dash="4 5")
        if key == "explore-poles":
            style = {"marker": "look", "size": 8, "fill_color": None, "source": self.curves}
            marks = figure.scatter("x", "y", **style, **_MARKS)
            turn = np.linspace(0, 2 * np.pi, 181)
            figure.line(np.cos(turn), np.sin(turn), line_color=GREY)
        else:
            marks = figure.multi_line("x", "y", line_dash="look", **_MARKS, source=self.curves)
        if key == "explore-rejection":
            figure.hspan(y=[1.0], line_color=GREY)
        elif key == "explore-nyquist":
            figure.scatter([-1.0], [0.0], marker="cross", size=13, line_color=GREY)
        tips = [("", "@name"), ("x", "$snap_x{%.4g}"), ("y", "$snap_y{%.4g}")]
        formats = dict.fromkeys(("$snap_x", "$snap_y"), "printf")
        figure.add_tools(HoverTool(renderers=[marks], tooltips=tips, formatters=formats))
        caption = Div(text=escape(words(key)["caption"]), sizing_mode="stretch_width")
        self.root = column(figure, caption, sizing_mode="stretch_width")

    def show(self, designs: Mapping[str, Shown], rules: Sequence[float]) -> None:
        """Show the curves of designs, each in the look of its place, and rules across them."""
        curves = {n: one.curves[self.key] for n, one in designs.items() if self.key in one.curves}
        self.rules.data = {"at": np.array(rules)}
        looks = {name: look for look, name in enumerate(designs) if name in curves}
        data: dict[str, list[Any]] = {
            "x": [x for x, _ in curves.values()],
            "y": [np.where(y > 0, y, np.nan) if self._is_log else y for _, y in curves.values()],
            "name": list(curves),
            "colour": list(map(colour, looks.values())),
            "look": list(map(_strokes, looks.values())),
        }
        if self.key == "explore-poles":  # a row for each
            data["look"] = [_MARKERS[look % len(_MARKERS)] for look in looks.values()]
            counts = [places.size for places in data["x"]]
            columns = {
                name: np.repeat(data[name], counts).tolist() for name in data if len(name) > 1
            }
            data = {name: list(np.concatenate(data[name])) for name in "xy"} | columns
        self.curves.data = data
        if curves:
            places = self.figure.x_range, self.figure.y_range
            for scale, (start, end) in zip(places, figure_ends(self.key, curves), strict=True):
                scale.update(start=start, end=end)


def _strokes(look: int) -> str:
    return " ".join(f"{2.4 * stroke:.0f}" for stroke in dashes(look)) or "solid"


def save_view(
    exploration: Exploration, view: View, folder: Path
) -> tuple[list[Path], tuple[str, ...]]:
    """Write a view into a folder under names that are free; return the files and their commands."""
    stem = next(
        stem
        for stem in (f"explored-{number}" for number in count(1))
        if not any((folder / (stem + ending)).exists() for ending in (".yaml", ".fits"))
    )
    config, gain = folder / f"{stem}.yaml", folder / f"{stem}.fits"
    request = view.request
    options = [f"--{name.replace('_', '-')} {value}" for name, value in request.given.items()]
    design = ["lbt-synth design", config.name, "--method", request.method.name, *options]
    commands = (
        " ".join((*design, "-o", gain.name)),
        f"lbt-synth report {config.name} {gain.name} -o {stem}.html",
    )
    moves = view.moves or "nothing moved"
    head = f"{exploration.config.source.name!a} with {moves}; {creator_name()}"
    text = config_text(view.config.settings, {"": "\n".join((head, *commands))})
    write_atomically(config, text.encode())
    save_gain(gain, view.design)
    return [config, gain], commands


def knob_slider(knob: Knob) -> Slider:
    """Return the slider of a knob, which stands at the logarithm of a value that has one."""
    unit, factor = knob.shown
    low, high, value = (_place(knob, value) for value in (knob.low, knob.high, knob.value))
    code = "return `${Number((factor * (log ? 10 ** tick : tick)).toPrecision(4))} ${unit}`"
    form = CustomJSTickFormatter(code=code, args={"factor": factor, "log": knob.log, "unit": unit})
    return Slider(
        name=knob.key,
        title=knob.label,
        start=low,
        end=high,
        value=value,
        step=(high - low) / 200,
        format=form,
    )


def _place(knob: Knob, value: float) -> float:
    return float(np.log10(value)) if knob.log else value


def _value(knob: Knob, place: float) -> float:
    """Return the value at a place of a slider, with four digits, as the slider shows it."""
    return float(f"{10**place if knob.log else place:.4g}")


_QUICK_S = 0.3  # a design that takes longer is made when a slider is released
_THREADS = 2  # of a page: a slow design leaves one for a quick one
_UNUSED_MS = 3_600_000  # after which the session of a page that sleeps is dropped
_SWITCH_S = 0.0005  # after which a thread that computes lets another go on; Python's 5 ms stutter
_GRID = {"display": "grid", "grid-template-columns": "repeat(auto-fill, minmax(330px, 1fr))"}
_HEAD = '{% block preamble %}<meta name="viewport" content="width=device-width">{% endblock %}'


class Session:
    """One open page."""

    def __init__(
        self, document: Any, exploration: Exploration, first: View, folder: Path, saved: list[Path]
    ) -> None:
        self._document, self._exploration, self._view = document, exploration, first
        self._folder, self._saved = folder, saved  # the files that all pages wrote
        self._asked = self._number = 0  # of the last wish, and of what is shown
        self._seconds: dict[str, float] = {}  # of the processor for the last design of a method
        self._kept: dict[str, Shown] = {}
        self._threads = ThreadPoolExecutor(_THREADS)
        self._sliders = {knob: knob_slider(knob) for knob in exploration.knobs}
        methods = [(m.name, m.title) for m in METHODS.values() if not m.of_record]
        name = first.request.method.name
        self._method = Select(name="method", title="Method", value=name, options=methods)
        self._verdict, self._facts, self._files = (
            Div(name=name, sizing_mode="stretch_width") for name in ("verdict", "facts", "saved")
        )
        self._panels = [LivePanel(key) for key in FIGURES]
        buttons = [Button(name=label.lower(), label=label) for label in ("Keep", "Save", "Reset")]
        for button, action in zip(buttons, (self._keep, self._save, self._reset), strict=True):
            button.on_click(action)
        self._method.on_change("value", lambda _, __, ___: self._ask(final=True))
        for slider in self._sliders.values():
            slider.on_change("value", lambda _, __, ___: self._ask(final=False))
            slider.on_change("value_throttled", lambda _, __, ___: self._ask(final=True))
        sticky = {"position": "sticky", "top": "0"}
        widgets = self._method, *self._sliders.values(), row(*buttons), self._files
        controls = column(*widgets, width=320, styles=sticky)
        wide = {"sizing_mode": "stretch_width"}
        figures = row(*(panel.root for panel in self._panels), styles=_GRID, **wide)
        curves = column(self._verdict, self._facts, figures, styles={"flex": "1 1 330px"}, **wide)
        document.add_root(row(controls, curves, styles={"flex-wrap": "wrap"}, **wide))
        document.template, document.title = _HEAD, f"Explore {exploration.config.source.name}"
        document.on_session_destroyed(self._close)
        self._show(0, first)
        self._ask(final=True)

    def _later(self, action: Callable[..., None], *arguments: Any) -> None:
        """Run an action on the document from any thread."""
        self._document.add_next_tick_callback(partial(action, *arguments))

    def _ask(self, *, final: bool) -> None:
        """Design anew; a slow method waits until the slider is released."""
        method = self._method.value
        if not final and self._seconds.get(method, 0.0) > _QUICK_S:
            return
        values = {}
        for knob, slider in self._sliders.items():
            slider.visible = knob.acts_on(method)
            if slider.value != _place(knob, knob.value):
                values[knob.key] = _value(knob, slider.value)
        self._asked += 1
        self._verdict.text = "Designing …"
        # in the unit of this page, which a thread does not know by itself
        context = copy_context().run
        self._threads.submit(context, self._work, self._asked, method, values, final)

    def _work(self, number: int, method: str, values: Mapping[str, float], final: bool) -> None:
        """Design in a thread, unless there is a newer wish; then show it, and form a verdict."""
        if number < self._asked:
            return
        try:
            start = time.thread_time()
            view = new_view(self._exploration, method, values)
            self._seconds[method] = time.thread_time() - start
            self._later(self._show, number, view)
            if final:
                self._later(self._say, number, judge(view))
        except Exception as error:  # the curves stay those of the last design
            self._later(self._say, number, str(error) or repr(error))

    def _say(self, number: int, text: str) -> None:
        """Say what is to be said of the last wish."""
        if number == self._asked:
            self._verdict.text = escape(text)

    def _show(self, number: int, view: View) -> None:
        """Show a view, unless a newer one is shown."""
        if number < self._number:
            return
        self._number, self._view = number, view
        shown = {**view.shown, **self._kept}
        for panel in self._panels:
            over_frequency = FIGURES[panel.key][0] == "frequency [Hz]"
            rules = view.config.truth.lines_hz if over_frequency else []
            panel.show(shown, [view.shift_hz] if panel.key == "explore-strehl" else rules)
        self._facts.text = table_html(shown)

    def _keep(self) -> None:
        """Keep the curves of the design that is shown."""
        view = self._view
        self._kept[f"{view.name}, {view.moves or 'kept'}"] = view.shown[view.name]
        self._show(self._number, view)

    def _save(self) -> None:
        try:
            paths, commands = save_view(self._exploration, self._view, self._folder)
        except LbtSynthError as error:
            self._files.text = escape(str(error))
            return
        self._saved.extend(paths)
        lines = [f"Written: {', '.join(map(str, paths))}. The commands that make them:", *commands]
        self._files.text = "".join(f"<p>{escape(line)}</p>" for line in lines)

    def _reset(self) -> None:
        """Put the sliders back, and drop the curves that were kept."""
        self._kept.clear()
        for knob, slider in self._sliders.items():
            slider.value = _place(knob, knob.value)
        self._ask(final=True)

    def _close(self, _: Any) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)


def table_html(shown: Mapping[str, Shown]) -> str:
    """Return what designs leave as a table of HTML, with the line that each is drawn in."""
    table = explored_table(shown)
    lines = ["".join(f"<th scope='col'>{escape(text)}</th>" for text in table.headings)]
    for look, (name, *cells) in enumerate(table.cells()):
        line = f"stroke='{colour(look)}' stroke-width='2' stroke-dasharray='{_strokes(look)}'"
        swatch = f"<svg width='34' height='9'><path d='M0 5H34' {line}/></svg>"
        rest = "".join(f"<td align='right'>{escape(cell.text)}</td>" for cell in cells)
        lines.append(f"<th scope='row' align='left'>{swatch} {escape(name.text)}</th>{rest}")
    return f"<table cellpadding='4'>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def serve(
    exploration: Exploration,
    first: View,
    folder: Path,
    *,
    host: str,
    port: int,
    origins: Sequence[str],
    announce: Callable[[str], None],
) -> list[Path]:
    """Serve the page until it is interrupted, and return the files that its users saved.

    ``origins`` are further addresses, as host:port, under which browsers may reach the page.
    ProblemError if there is no such place to serve.
    """
    saved: list[Path] = []

    def open_page(document: Any) -> None:
        Session(document, exploration, first, folder, saved)

    place = port
    try:
        for family, *_, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            with socket.create_server((address[0], place), family=family) as probe:
                place = probe.getsockname()[1]
    except (OSError, UnicodeError) as error:  # a name of another alphabet, or too long
        reason = getattr(error, "strerror", None) or str(error)
        raise ProblemError(
            f"cannot serve at --host {host} --port {port}: {reason}. Try another one; --port 0 is "
            "any that is free."
        ) from error
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    hosts = (f"{one}:{place}" for one in ("localhost", "127.0.0.1", name))
    server = Server(
        {"/": open_page},
        address=host,
        port=place,
        allow_websocket_origin=[*hosts, *origins],
        unused_session_lifetime_milliseconds=_UNUSED_MS,
    )
    # a thread that computes must not keep curves from being sent
    sys.setswitchinterval(_SWITCH_S)
    server.start()
    try:
        announce(f"http://{name}:{place}/")
        server.io_loop.start()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()
    return saved
