"""The page of sliders: its figures, and the server, with one session per open page.

Scales of figures move in steps, so that curves move in them; designs are made in threads.
"""

from __future__ import annotations

import errno
import json
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextvars import copy_context
from functools import partial
from importlib.resources import files
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, TypeAlias

import numpy as np
from bokeh.core.properties import String
from bokeh.model import DataModel
from bokeh.models import ColumnDataSource, GridBox, HoverTool, PlainText, Range1d
from bokeh.plotting import figure as new_figure
from bokeh.server.server import Server

from lbt_synth.config.write import config_text
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.files import save_gain
from lbt_synth.methods.registry import METHODS
from lbt_synth.report.draw import colour, dashes
from lbt_synth.report.explore.exploration import (
    Exploration,
    Shown,
    View,
    describe_moves,
    explored_table,
    judge,
    quick_view,
    whole_view,
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
_FAR = 9.0  # outside that plane; a canvas takes no larger numbers
_ROOM = 0.05  # decades above the highest curve
_GREY = "#404040"
# of each figure: what is on its axes, and which of them are logarithmic
_AXES = {
    "explore-rejection": ("frequency [Hz]", "\u03c3\u0304, phase to residual [-]", "xy"),
    "explore-noise": ("frequency [Hz]", "\u03c3\u0304, noise to residual [-]", "xy"),
    "explore-nyquist": ("real part [-]", "imaginary part [-]", ""),
    "explore-spectrum": ("frequency [Hz]", "power spectrum [{nm²/Hz}]", "xy"),
    "explore-strehl": ("frequency error [Hz]", "Strehl ratio [%]", ""),
    "explore-poles": ("real part [-]", "imaginary part [-]", ""),
    "explore-sigma": ("frequency [Hz]", "\u03c3\u0304, disturbances to error [{nm}]", "xy"),
}
_STYLE = {
    "axis_label_text_font_size": "13px",
    "axis_label_text_font_style": "normal",
    "major_label_text_font_size": "12px",
    "axis_line_color": "#808080",
    "minor_tick_line_color": None,
}


def explore_numbers(
    shown: Mapping[str, Shown], lines_hz: Sequence[float], shift_hz: float
) -> dict[str, Numbers]:
    """Return what each figure shows of designs, with true lines and where the slider stands."""
    density, error = shown_unit("nm²/Hz")[1], shown_unit("nm")[1]
    numbers: dict[str, Numbers] = {}
    for key, field, factor, decades in (
        ("explore-rejection", "rejection", 1.0, 4),
        ("explore-noise", "noise_transfer", 1.0, 2),
        ("explore-spectrum", "spectrum_nm2_hz", density, 4),
        ("explore-sigma", "error_nm", error, 2),
    ):
        curves = {
            name: (one.frequency_hz, factor * getattr(one, field))
            for name, one in shown.items()
            if getattr(one, field) is not None
        }
        values = np.concatenate([np.ones(1), *(y for _, y in curves.values())])
        high = float(10.0 ** np.ceil(np.log10(np.nanmax(values)) + _ROOM))
        grid = next(iter(shown.values())).frequency_hz
        ends = (float(grid[0]), float(grid[-1])), (high / 10**decades, high)
        numbers[key] = curves, lines_hz, ends
    numbers["explore-nyquist"] = (
        {name: _loop_gains(one) for name, one in shown.items()},
        (),
        ((-1.0 - _REACH, -1.0 + _REACH), (-_REACH, _REACH)),
    )
    poles = {name: (one.poles.real, one.poles.imag) for name, one in shown.items()}
    numbers["explore-poles"] = poles, (), ((-1.2, 1.2), (-1.2, 1.2))
    strehls = {
        name: (one.shift_hz, 100 * one.strehls)
        for name, one in shown.items()
        if one.shift_hz is not None and one.strehls is not None
    }
    percents = np.concatenate([np.zeros(0), *(y for _, y in strehls.values())])
    low = strehl_axis(percents)["low"]
    high = np.nanmax(percents) if np.isfinite(percents).any() else 100.0
    shifts = np.concatenate([np.array([shift_hz]), *(x for x, _ in strehls.values())])
    across = float(np.min(shifts)) - 1e-9, float(np.max(shifts)) + 1e-9
    numbers["explore-strehl"] = strehls, [shift_hz], (across, (low, high + 0.04 * (high - low)))
    return {key: numbers[key] for key in _AXES}


def _loop_gains(one: Shown) -> tuple[FloatArray, FloatArray]:
    """Return the loop gains of all measurements, each broken in turn, with gaps between them."""
    near = np.clip(one.broken.real, -_FAR, _FAR) + 1j * np.clip(one.broken.imag, -_FAR, _FAR)
    line = np.pad(near, ((0, 0), (0, 1)), constant_values=np.nan).ravel()
    return line.real, line.imag


class LivePanel:
    """A place for a figure, which is made again only where its designs are others."""

    def __init__(self, key: str) -> None:
        self.root = GridBox(name=key, sizing_mode="stretch_width")
        self._key = key
        self._texts = [
            text.format_map({unit: shown_unit(unit)[0] for unit in ("nm", "nm²/Hz")})
            for text in _AXES[key][:2]
        ]
        self._log = _AXES[key][2]
        self._designs: object = None
        self._ends: Ends | None = None
        self._sources: list[ColumnDataSource] = []

    def show(self, numbers: Numbers, looks: Mapping[str, int]) -> None:
        """Show curves in the looks of their designs."""
        curves, rules, ends = numbers
        groups: dict[bytes, list[str]] = {}  # curves of the same abscissae are sent together
        for name, (x, _) in curves.items():
            groups.setdefault(x.tobytes(), []).append(name)
        columns = [{"at": np.array(rules)}] if len(rules) else []
        for names in groups.values():
            ordinates = {f"y{i}": self._drawn(curves[name][1]) for i, name in enumerate(names)}
            columns.append({"x": curves[names[0]][0], **ordinates})
        designs = [[(name, looks[name]) for name in names] for names in groups.values()]
        if [bool(rules), *designs] != self._designs:
            self._designs, self._ends = [bool(rules), *designs], None
            self._sources = [ColumnDataSource(one) for one in columns]
            self.root.children = [(self._new_figure(designs, bool(rules)), 0, 0)]
        else:
            for source, new in zip(self._sources, columns, strict=True):
                old = source.data
                if not all(np.array_equal(old[n], new[n], equal_nan=True) for n in new):
                    source.data = new
        if ends != self._ends:
            self._ends, figure = ends, self.root.children[0][0]
            for scale, (start, end) in zip((figure.x_range, figure.y_range), ends, strict=True):
                scale.update(start=start, end=end)

    def _drawn(self, y: FloatArray) -> FloatArray:
        return np.where(y > 0, y, np.nan) if "y" in self._log else y

    def _new_figure(self, designs: Sequence[Sequence[tuple[str, int]]], ruled: bool) -> Any:
        square = self._key in ("explore-nyquist", "explore-poles")
        size = {"aspect_ratio": 1.0, "max_width": 460} if square else {"height": 300}
        figure = new_figure(
            **{f"{n}_axis_type": "log" if n in self._log else "linear" for n in "xy"},
            x_range=Range1d(),
            y_range=Range1d(),
            sizing_mode="stretch_width",
            tools="box_zoom,pan,wheel_zoom,reset",
            toolbar_location="above",
            min_border_left=64,  # figures above each other are in line
            min_border_right=12,
            **size,
        )
        # a finger scrolls the page
        figure.toolbar.update(logo=None, active_drag=None, active_scroll=None)
        figure.grid.grid_line_color = "#e0e0e0"
        figure.outline_line_color = None
        for axis, text in zip((figure.xaxis[0], figure.yaxis[0]), self._texts, strict=True):
            axis.update(axis_label=PlainText(text=text), **_STYLE)
        remaining = iter(self._sources)
        if ruled:
            dash = "6 3" if self._key == "explore-strehl" else "4 5"
            style = {"line_color": _GREY, "line_width": 1.2, "line_dash": dash}
            figure.vspan(x="at", source=next(remaining), **style)
        curves = []
        for group, source in zip(designs, remaining, strict=True):
            for i, (name, look) in enumerate(group):
                curves.append(self._new_curve(figure, source, f"y{i}", look))
                curves[-1].name = f"design {name}"
        self._draw_guides(figure)
        tips = [("", "$name")]
        tips += [(t, f"$snap_{n}{{%.4g}}") for t, n in zip(self._texts, "xy", strict=True)]
        formats = {f"$snap_{n}": "printf" for n in "xy"}
        figure.add_tools(HoverTool(renderers=curves, tooltips=tips, formatters=formats))
        return figure

    def _new_curve(self, figure: Any, source: ColumnDataSource, y: str, look: int) -> Any:
        shade, place = colour(look), {"x": "x", "y": y, "source": source}
        if self._key == "explore-poles":
            markers = ("circle", "square", "triangle", "diamond", "cross", "x")
            style = {"size": 8, "line_width": 1.5, "fill_color": None, "line_color": shade}
            return figure.scatter(**place, marker=markers[look % len(markers)], **style)
        strokes = [max(1, round(2.4 * stroke)) for stroke in dashes(look)]
        return figure.line(**place, line_color=shade, line_width=2, line_dash=strokes)

    def _draw_guides(self, figure: Any) -> None:
        """Draw what the curves are compared with."""
        thin = {"line_color": _GREY, "line_width": 1.2}
        if self._key == "explore-rejection":
            figure.hspan(y=[1.0], **thin)
        elif self._key == "explore-nyquist":
            figure.scatter([-1.0], [0.0], marker="cross", size=13, line_color=_GREY)
        elif self._key == "explore-poles":
            turn = np.linspace(0, 2 * np.pi, 181)
            figure.line(np.cos(turn), np.sin(turn), **thin)


class Lane:
    """Runs one piece of work after another in a thread; newer work replaces what still waits.

    The thread shows wavefronts in the unit of its maker, and ends with the program, even in the
    middle of its work.
    """

    def __init__(self) -> None:
        self._queue: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = Thread(target=copy_context().run, args=(self._run,), daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[], None]) -> None:
        """Run a piece of work, instead of any that waits."""
        self._queue.put(work)

    @property
    def is_waiting(self) -> bool:
        """Whether newer work waits for the one that runs."""
        return not self._queue.empty()

    def close(self) -> None:
        """Drop what waits, and end after what runs."""
        self._queue.put(None)

    def _run(self) -> None:
        while True:
            work = self._queue.get()
            while not self._queue.empty():
                work = self._queue.get()
            if work is None:
                return
            work()


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


_QUICK_S = 0.3  # a design that takes longer is made when a slider is released, in its own lane
_MOST_KEPT = 5
_SWITCH_S = 0.0005  # after which a thread that computes lets another go on
_UNUSED_MS = 3_600_000  # after which the session of a page that sleeps is dropped


class Exchange(DataModel):  # type: ignore[misc]  # bokeh has no types
    """What a page and its session tell each other, as JSON."""

    wish = String("")
    answer = String("")
    verdict = String("")
    saved = String("")


class Session:
    """One open page."""

    def __init__(
        self, document: Any, exploration: Exploration, first: View, folder: Path, saved: list[Path]
    ) -> None:
        self._document, self._exploration, self._view = document, exploration, first
        self._folder, self._saved = folder, saved  # the files that all pages wrote
        self._number = 0
        self._seconds: dict[str, float] = {}  # of the processor for the last design of a method
        self._kept: dict[str, Shown] = {}
        self._quick, self._slow, self._third = Lane(), Lane(), Lane()
        self._exchange = Exchange(name="exchange")
        keys = explore_numbers(first.shown, (), 0.0)
        self._panels = {key: LivePanel(key) for key in keys}
        for panel in self._panels.values():
            document.add_root(panel.root)
        next(iter(self._panels.values())).root.tags = [self._exchange]
        self._show_view(0, first)
        self._exchange.on_change("wish", lambda _, __, new: self._hear(json.loads(new)))
        self._third.submit(partial(self._form_verdict, 0, first))
        document.on_session_destroyed(self._close)
        here = files("lbt_synth.report")
        style, script, template = (
            (here / name).read_text(encoding="utf-8")
            for name in ("explore/page.css", "explore/page.js", "explore/page.html.jinja")
        )
        document.template = template
        document.title = f"Explore {exploration.config.source.name}"
        document.template_variables.update(
            {
                "heading": document.title,
                "charts": [{"key": key, **words()[key]} for key in keys],
                "knobs": exploration.knobs,
                "methods": {m.name: m.title for m in METHODS.values()},
                "method": first.request.method.name,
                "folder": str(folder),
                "style": (here / "page/page.css").read_text(encoding="utf-8") + style,
                "script": script,
            }
        )

    def _hear(self, message: Mapping[str, Any]) -> None:
        """Do what the page asks for."""
        match message["do"]:
            case "design":
                method, number = str(message["method"]), int(message["number"])
                quick = self._seconds.get(method, _QUICK_S) < _QUICK_S
                lane = self._quick if quick else self._slow
                wish = number, method, dict(message["values"]), bool(message["final"])
                lane.submit(partial(self._work, lane, *wish))
            case "keep":
                self._keep()
            case "drop":
                self._kept.pop(str(message["name"]), None)
                self._show_view(self._number, self._view)
            case "save":
                self._save()

    def _work(
        self, lane: Lane, number: int, method: str, values: Mapping[str, float], final: bool
    ) -> None:
        """Design in a thread: show the curves first, then what they leave, then the verdict."""
        exploration, start = self._exploration, time.thread_time()
        try:
            view = quick_view(exploration, method, values, self._view)
            self._seconds[method] = time.thread_time() - start
            self._later(self._show_view, number, view)
            if lane.is_waiting:
                return
            view = whole_view(exploration, view)
            self._later(self._show_view, number, view)
        except Exception as error:
            self._later(self._complain, number, error)
            return
        if final:
            self._third.submit(partial(self._form_verdict, number, view))

    def _form_verdict(self, number: int, view: View) -> None:
        try:
            text = judge(view)
        except LbtSynthError as error:
            text = str(error)
        self._later(self._say_verdict, number, text)

    def _later(self, action: Callable[..., None], *arguments: Any) -> None:
        """Run an action on the document from any thread."""
        self._document.add_next_tick_callback(partial(action, *arguments))

    def _show_view(self, number: int, view: View) -> None:
        """Show a view, unless a newer one is shown."""
        if number < self._number:
            return
        self._number, self._view = number, view
        shown = {**view.shown, **self._kept}
        looks = {name: look for look, name in enumerate(shown)}
        lines_hz = view.config.truth.lines_hz
        for key, numbers in explore_numbers(shown, lines_hz, view.shift_hz).items():
            self._panels[key].show(numbers, looks)
        table = explored_table(shown)
        self._answer(
            number=number,
            whole=view.is_whole,
            slow=self._seconds.get(view.request.method.name, 0.0) > _QUICK_S,
            headings=table.headings,
            rows=[[cell.text for cell in row] for row in table.cells()],
            legend=[
                {
                    "name": name,
                    "colour": colour(look),
                    "dashes": " ".join(f"{2 * stroke:g}" for stroke in dashes(look)),
                    "kept": name in self._kept,
                }
                for look, name in enumerate(shown)
            ],
        )

    def _answer(self, **content: Any) -> None:
        self._exchange.answer = json.dumps(content)

    def _complain(self, number: int, error: Exception) -> None:
        """Say why a wish has no design; the curves stay those of the last one."""
        if number < self._number:
            return
        self._number = number
        known = isinstance(error, LbtSynthError)
        self._answer(
            number=number, error=str(error) if known else f"{type(error).__name__}: {error}"
        )

    def _say_verdict(self, number: int, text: str) -> None:
        if number == self._number:
            self._exchange.verdict = json.dumps({"number": number, "text": text})

    def _keep(self) -> None:
        """Keep the curves of the design that is shown."""
        exploration = self._exploration
        view = self._view if self._view.is_whole else whole_view(exploration, self._view)
        moves = describe_moves(exploration, view)
        name = f"{view.name}, {moves}" if moves else f"{view.name}, kept"
        self._kept.pop(name, None)
        if len(self._kept) == _MOST_KEPT:
            del self._kept[next(iter(self._kept))]
        self._kept[name] = view.shown[view.name]
        self._show_view(self._number, view)

    def _save(self) -> None:
        try:
            paths, commands = save_view(self._exploration, self._view, self._folder)
        except LbtSynthError as error:
            self._exchange.saved = json.dumps({"time": time.time(), "error": str(error)})
            return
        self._saved.extend(paths)
        names = [str(path) for path in paths]
        self._exchange.saved = json.dumps(
            {"time": time.time(), "files": names, "commands": commands}
        )

    def _close(self, _: Any) -> None:
        for lane in (self._quick, self._slow, self._third):
            lane.close()


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
