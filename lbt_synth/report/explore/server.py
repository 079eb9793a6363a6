"""The page of sliders: widgets and figures of Bokeh, and the server, with a session per open page.

Scales of figures move in steps, so that curves move in them; designs are made in threads.
"""

from __future__ import annotations

import errno
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
from typing import Any, TypeAlias

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
    Exploration,
    Knob,
    Shown,
    View,
    describe_moves,
    explored_table,
    judge,
    new_view,
)
from lbt_synth.report.figures.studies import strehl_axis
from lbt_synth.report.page.html import creator_name, words
from lbt_synth.storage.atomic_files import write_together
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.validation import FloatArray

Ends: TypeAlias = tuple[tuple[float, float], tuple[float, float]]  # of the scales of x and y
# curves by the names of designs, abscissae of rules, and the scales
Numbers: TypeAlias = tuple[dict[str, tuple[FloatArray, FloatArray]], Sequence[float], Ends]
_REACH = 3.0  # of the plane of a loop gain, to each side of -1
_FAR = 3 * _REACH  # outside that plane; a canvas takes no larger numbers
_DECADES = 4  # of a logarithmic scale of ordinates
# of each figure: what is on its axes, with units of wavefronts in braces; those over frequency show
# a field of a design on logarithmic scales
_FIELDS = {
    "explore-rejection": "rejection",
    "explore-noise": "noise_transfer",
    "explore-spectrum": "spectrum_nm2_hz",
    "explore-sigma": "error_nm",
}
_AXES = {
    "explore-rejection": ("frequency [Hz]", "\u03c3\u0304, phase to residual [-]"),
    "explore-noise": ("frequency [Hz]", "\u03c3\u0304, noise to residual [-]"),
    "explore-nyquist": ("real part [-]", "imaginary part [-]"),
    "explore-spectrum": ("frequency [Hz]", "power spectrum [{nm²/Hz}]"),
    "explore-strehl": ("frequency error [Hz]", "Strehl ratio [%]"),
    "explore-poles": ("real part [-]", "imaginary part [-]"),
    "explore-sigma": ("frequency [Hz]", "\u03c3\u0304, disturbances to error [{nm}]"),
}


def explore_numbers(
    shown: Mapping[str, Shown], lines_hz: Sequence[float], shift_hz: float
) -> dict[str, Numbers]:
    """Return what each figure shows of designs, with true lines and where the slider stands."""
    numbers: dict[str, Numbers] = {}
    factors = {"spectrum_nm2_hz": shown_unit("nm²/Hz")[1], "error_nm": shown_unit("nm")[1]}
    for key, field in _FIELDS.items():
        curves = {
            name: (one.frequency_hz, factors.get(field, 1.0) * getattr(one, field))
            for name, one in shown.items()
            if getattr(one, field) is not None
        }
        values = np.concatenate([np.ones(1), *(y for _, y in curves.values())])
        high = float(10.0 ** np.ceil(np.log10(1.1 * np.nanmax(values))))
        grid = next(iter(shown.values())).frequency_hz
        ends = (float(grid[0]), float(grid[-1])), (high / 10**_DECADES, high)
        numbers[key] = curves, lines_hz, ends
    plane = (-1.0 - _REACH, -1.0 + _REACH), (-_REACH, _REACH)
    gains = {name: _loop_gains(one) for name, one in shown.items()}
    numbers["explore-nyquist"] = gains, (), plane
    poles = {name: (one.poles.real, one.poles.imag) for name, one in shown.items()}
    numbers["explore-poles"] = poles, (), ((-1.2, 1.2), (-1.2, 1.2))
    strehls = {name: (one.shift_hz, 100 * one.strehls) for name, one in shown.items()}
    percents = np.concatenate([y for _, y in strehls.values()])
    low = strehl_axis(percents)["low"]
    high = np.nanmax(percents) if np.isfinite(percents).any() else 100.0
    shifts = np.concatenate([x for x, _ in strehls.values()])
    across = float(np.min(shifts)) - 1e-9, float(np.max(shifts)) + 1e-9
    numbers["explore-strehl"] = strehls, [shift_hz], (across, (low, high + 0.04 * (high - low)))
    return numbers


def _loop_gains(one: Shown) -> tuple[FloatArray, FloatArray]:
    """Return the loop gains of all measurements, each broken in turn, with gaps between them."""
    near = np.clip(one.broken.real, -_FAR, _FAR) + 1j * np.clip(one.broken.imag, -_FAR, _FAR)
    line = np.pad(near, ((0, 0), (0, 1)), constant_values=np.nan).ravel()
    return line.real, line.imag


class LivePanel:
    """A figure with the curves of all designs, the rules across them, and what they mean."""

    def __init__(self, key: str) -> None:
        units = {unit: shown_unit(unit)[0] for unit in ("nm", "nm²/Hz")}
        self._is_log, self._is_points = key in _FIELDS, key == "explore-poles"
        square, scale = (
            key in ("explore-nyquist", "explore-poles"),
            "log" if self._is_log else "linear",
        )
        self.figure = figure = new_figure(
            name=key,
            title=words()[key]["title"],
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
        for axis, text in zip((figure.xaxis[0], figure.yaxis[0]), _AXES[key], strict=True):
            axis.axis_label = PlainText(text=text.format_map(units))
        self.rules = ColumnDataSource({"at": []})
        self.curves = ColumnDataSource({name: [] for name in ("x", "y", "name", "colour", "look")})
        figure.vspan(x="at", source=self.rules, line_color=GREY, line_dash="4 5")
        if self._is_points:
            marks = figure.scatter(
                "x", "y", marker="look", size=8, fill_color=None, **_MARKS, source=self.curves
            )
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
        caption = Div(text=escape(words()[key]["caption"]), sizing_mode="stretch_width")
        self.root = column(figure, caption, sizing_mode="stretch_width")

    def show(self, numbers: Numbers, looks: Mapping[str, int]) -> None:
        """Show curves in the looks of their designs."""
        curves, rules, ends = numbers
        self.rules.data = {"at": np.array(rules)}
        x = [x for x, _ in curves.values()]
        y = [np.where(y > 0, y, np.nan) if self._is_log else y for _, y in curves.values()]
        name, number = list(curves), [looks[name] for name in curves]
        look = list(map(_strokes, number))
        if self._is_points:  # a row for each
            counts = [places.size for places in x]
            name, number = (np.repeat(column, counts).tolist() for column in (name, number))
            x, y = list(np.concatenate(x)), list(np.concatenate(y))
            look = [_MARKERS[one % len(_MARKERS)] for one in number]
        shades = list(map(colour, number))
        self.curves.data = {"x": x, "y": y, "name": name, "colour": shades, "look": look}
        places = self.figure.x_range, self.figure.y_range
        for scale, (start, end) in zip(places, ends, strict=True):
            scale.update(start=start, end=end)


_MARKS: dict[str, Any] = {"line_color": "colour", "line_width": 2}
_MARKERS = ("circle", "square", "triangle", "diamond", "cross", "x")


def _strokes(look: int) -> str:
    return " ".join(f"{2.4 * stroke:.0f}" for stroke in dashes(look)) or "solid"


_ENDINGS = (".yaml", ".fits", ".sh")


def save_view(
    exploration: Exploration, view: View, folder: Path
) -> tuple[list[Path], tuple[str, ...]]:
    """Write a view into a folder under names that are free; return the files and their commands."""
    stem = next(
        stem
        for stem in (f"explored-{number}" for number in count(1))
        if not any((folder / (stem + ending)).exists() for ending in _ENDINGS)
    )
    config, gain, script = (folder / (stem + ending) for ending in _ENDINGS)
    request = view.request
    options = [f"--{name.replace('_', '-')} {value}" for name, value in request.given.items()]
    design = ["lbt-synth design", config.name, "--method", request.method.name, *options]
    commands = (
        " ".join((*design, "-o", gain.name)),
        f"lbt-synth report {config.name} {gain.name} -o {stem}.html",
    )
    moves = describe_moves(exploration, view) or "nothing moved"
    head = f"{exploration.config.source.name!a} with {moves}; {creator_name()}"
    lines = ["#!/bin/sh", f"# {head}", "set -e", 'cd "$(dirname "$0")"', *commands, ""]
    text = config_text(view.config.settings, {"": "\n".join((head, *commands))})
    write_together({config: text.encode(), script: "\n".join(lines).encode()})
    save_gain(gain, view.design)
    return [config, gain, script], commands


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
_THREADS = 3  # of a page: for a slow design, a quick one, and a verdict
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
        methods = [(method.name, method.title) for method in METHODS.values()]
        name = first.request.method.name
        self._method = Select(name="method", title="Method", value=name, options=methods)
        self._verdict, self._facts, self._files = (
            Div(name=name, sizing_mode="stretch_width") for name in ("verdict", "facts", "saved")
        )
        self._panels = {key: LivePanel(key) for key in _AXES}
        buttons = [Button(name=label.lower(), label=label) for label in ("Keep", "Save", "Reset")]
        for button, action in zip(buttons, (self._keep, self._save, self._reset), strict=True):
            button.on_click(action)
        self._method.on_change("value", lambda _, __, ___: self._ask(final=True))
        for slider in self._sliders.values():
            slider.on_change("value", lambda _, __, ___: self._ask(final=False))
            slider.on_change("value_throttled", lambda _, __, ___: self._ask(final=True))
        controls = column(
            self._method,
            *self._sliders.values(),
            row(*buttons),
            self._files,
            width=320,
            styles={"position": "sticky", "top": "0"},
        )
        wide = {"sizing_mode": "stretch_width"}
        figures = row(*(panel.root for panel in self._panels.values()), styles=_GRID, **wide)
        curves = column(self._verdict, self._facts, figures, styles={"flex": "1 1 330px"}, **wide)
        document.add_root(row(controls, curves, styles={"flex-wrap": "wrap"}, **wide))
        document.template, document.title = _HEAD, f"Explore {exploration.config.source.name}"
        document.on_session_destroyed(self._close)
        self._hide_sliders()
        self._show(0, first)
        self._submit(0, self._judge, first)

    def _submit(self, number: int, work: Callable[..., None], *arguments: Any) -> None:
        """Work on a wish in a thread, in the unit of this one; say what fails."""

        def run() -> None:
            try:
                work(number, *arguments)
            except Exception as error:  # the curves stay those of the last design
                self._later(self._say, number, str(error) or repr(error))

        self._threads.submit(copy_context().run, run)

    def _later(self, action: Callable[..., None], *arguments: Any) -> None:
        """Run an action on the document from any thread."""
        self._document.add_next_tick_callback(partial(action, *arguments))

    def _hide_sliders(self) -> None:
        for knob, slider in self._sliders.items():
            slider.visible = knob.acts_on(self._method.value)

    def _ask(self, *, final: bool) -> None:
        """Design anew; a slow method waits until the slider is released."""
        method = self._method.value
        if not final and self._seconds.get(method, 0.0) > _QUICK_S:
            return
        self._hide_sliders()
        self._asked += 1
        self._verdict.text = "Designing …"
        values = {
            knob.key: _value(knob, slider.value)
            for knob, slider in self._sliders.items()
            if slider.value != _place(knob, knob.value)
        }
        self._submit(self._asked, self._work, method, values, final)

    def _work(self, number: int, method: str, values: Mapping[str, float], final: bool) -> None:
        """Design in a thread, unless there is a newer wish; then show it, and form a verdict."""
        if number < self._asked:
            return
        start = time.thread_time()
        view = new_view(self._exploration, method, values)
        self._seconds[method] = time.thread_time() - start
        self._later(self._show, number, view)
        if final:
            self._judge(number, view)

    def _judge(self, number: int, view: View) -> None:
        self._later(self._say, number, judge(view))

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
        looks = {name: look for look, name in enumerate(shown)}
        lines_hz = view.config.truth.lines_hz
        for key, numbers in explore_numbers(shown, lines_hz, view.shift_hz).items():
            self._panels[key].show(numbers, looks)
        self._facts.text = table_html(shown)

    def _keep(self) -> None:
        """Keep the curves of the design that is shown."""
        view = self._view
        moves = describe_moves(self._exploration, view)
        name = f"{view.name}, {moves}" if moves else f"{view.name}, kept"
        self._kept[name] = view.shown[view.name]
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

    place = _require_free(host, port)
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    own = (f"{one}:{place}" for one in ("localhost", "127.0.0.1", name))
    server = Server(
        {"/": open_page},
        address=host,
        port=place,
        allow_websocket_origin=[*own, *origins],
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


def _require_free(host: str, port: int) -> int:
    """Return a port that is free at a host, for 0 any; refuse one that is not."""
    try:
        for family, *_, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            with socket.create_server((address[0], port), family=family) as probe:
                port = probe.getsockname()[1]
    except (OSError, UnicodeError) as error:  # a name of another alphabet, or too long
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            text = f"--port {port} is in use; give another one, or 0 for any that is free."
        else:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            text = f"cannot serve at --host {host} --port {port}: {reason}."
        raise ProblemError(text) from error
    return port
