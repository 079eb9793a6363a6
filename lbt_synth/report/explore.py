"""The page of sliders: what moves, what is shown of it, and Bokeh's server and widgets.

A knob edits numbers of the configuration, so that whatever is seen can be saved.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from bokeh.layouts import column, grid, row
from bokeh.models import (
    Button,
    ColumnDataSource,
    Div,
    HoverTool,
    Legend,
    PlainText,
    PreText,
    Select,
    Slider,
)
from bokeh.plotting import figure as new_figure
from bokeh.server.server import Server

from lbt_synth.config import Config
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.samples import with_values
from lbt_synth.config.schema import FileSection, TrueVibrationSection
from lbt_synth.config.write import config_text
from lbt_synth.design import Design
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.files import save_gain
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import close_loop, loop_margins, stable_sensor_gains
from lbt_synth.methods.registry import METHODS, default_method, method_named
from lbt_synth.methods.request import DesignRequest, design_request
from lbt_synth.report.designs import frequency_errors, require_compatible
from lbt_synth.report.draw import GREY, colour, dashes
from lbt_synth.report.figures.loops import frequency_grid
from lbt_synth.report.figures.records import SEGMENT, exact_spectrum
from lbt_synth.report.page.html import creator_name
from lbt_synth.report.screen import say_residual
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import fact, facts, row_table
from lbt_synth.storage.tables import Table, text_lines
from lbt_synth.storage.words import count_text
from lbt_synth.studies import robustness_map
from lbt_synth.studies.limits import compare_in_truth
from lbt_synth.validation import FloatArray

Curve: TypeAlias = tuple[FloatArray, FloatArray]  # abscissae and ordinates, in units that are shown
Designs: TypeAlias = Mapping[str, Design]
SHIFT = "shift"  # key of the knob that moves the true lines
STREHL = "Strehl ratio"  # title of the figure that takes longer than the others


@dataclass(frozen=True, slots=True)
class Knob:
    """One number that can be moved."""

    key: str
    label: str
    unit: str  # empty for a pure number
    low: float
    high: float
    value: float  # where it stands before it is moved
    edit: Callable[[FileSection, float], FileSection]  # puts a value into settings


def list_knobs(config: Config) -> Iterator[Knob]:
    """Yield what can be moved in a configuration: the loop and the sky, then the design."""
    settings, gain = config.settings, config.truth.sensor_gain * config.sensor_gain
    delay, air = settings.loop.delay_frames, settings.atmosphere
    edit = partial(_scale, "loop", "delay_frames", delay)
    yield Knob("delay", "total delay", "frames", 1.0, max(6.0, delay), delay, edit)
    edit = partial(_scale, "truth", "sensor_gain", gain)
    yield Knob("gain", "real sensor gain", "", gain / 5, 2.5 * gain, gain, edit)
    noise_nm = float(np.sqrt(np.mean(np.square(config.noise_nm))))
    if noise_nm > 0:
        edit = partial(_scale_noise, config.noise_nm, noise_nm)
        yield Knob("noise", "measurement noise", "nm", noise_nm / 5, 5 * noise_nm, noise_nm, edit)
    low, high = frequency_errors(config)[[0, -1]].tolist()
    if low < high:
        label, edit = "frequency error, true less assumed", partial(_shift, config)
        yield Knob(SHIFT, label, "Hz", low, high, 0.0, edit)
    for key, label, unit, name in (
        ("seeing", "seeing", "arcsec", "seeing_arcsec"),
        ("wind", "wind speed", "m/s", "wind_speed_m_s"),
    ):
        if air is not None:
            value = float(getattr(air, name))
            edit = partial(_scale, "atmosphere", name, value)
            yield Knob(key, label, unit, value / 4, 4 * value, value, edit)
    if lines := settings.model.vibrations:
        damping = float(np.exp(np.mean(np.log([line.damping for line in lines]))))
        ends, edit = (damping / 5, min(5 * damping, 0.9)), partial(_scale_damping, config, damping)
        yield Knob("damping", "assumed damping", "", *ends, damping, edit)
    ratio = float(settings.design.gamma_ratio)
    methods = ", ".join(name for name, m in METHODS.items() if "gamma_ratio" in m.configurable)
    edit = partial(_scale, "design", "gamma_ratio", ratio)
    yield Knob("gamma_ratio", f"gamma ratio of {methods}", "", 1.0, 3.0, ratio, edit)


def _scale(
    section: str, name: str, start: float, settings: FileSection, value: float
) -> FileSection:
    """Scale a number of a section from its start."""
    scaled = getattr(getattr(settings, section), name) * value / start
    # the value of the slider, and not a neighbour by rounding
    return with_values(settings, {(section, name): float(f"{scaled:.12g}")})


def _scale_noise(
    noises_nm: float | FloatArray, start: float, settings: FileSection, value: float
) -> FileSection:
    """Scale the noise of all measurements."""
    scaled = (value / start * np.asarray(noises_nm)).tolist()
    sizes = {"noise_nm": scaled, "noise_mas": None, "pyramid": None}
    return with_values(settings, {("sensor", name): size for name, size in sizes.items()})


def _shift(config: Config, settings: FileSection, value: float) -> FileSection:
    """Move the true lines, the one that moves most by a shift; those of the model stay."""
    lines = []
    for line in _true_lines(config, settings):
        moved_hz = line.frequency_hz + config.truth.frequency_shift_hz(line.frequency_hz, value)
        lines.append(line.model_copy(update={"frequency_hz": moved_hz}))
    return with_values(settings, {("truth", "vibrations"): lines})


def _scale_damping(
    config: Config, start: float, settings: FileSection, value: float
) -> FileSection:
    """Scale the damping of the lines of the model; those of the truth stay."""
    edits: dict[Any, Any] = {("truth", "vibrations"): _true_lines(config, settings)}
    for i, line in enumerate(settings.model.vibrations or ()):
        if line.damping < 0.99:  # from there on it is a drift
            scaled = min(line.damping * value / start, 0.99)
            edits["model", "vibrations", i, "damping"] = scaled
    return with_values(settings, edits)


def _true_lines(config: Config, settings: FileSection) -> list[TrueVibrationSection]:
    """Return the lines of the truth; those that it takes from the model become its own."""
    if isinstance(settings.truth.vibrations, list):
        return settings.truth.vibrations
    sections, lines = [], config.plant.vibrations
    errors = config.truth.frequency_errors_hz or (None,) * len(lines)
    every = config.plant.motions or ({},) * len(lines)
    for line, error_hz, motions in zip(lines, errors, every, strict=True):
        names = ("frequency_hz", "damping", "rms_nm", "sections")
        content = {"kind": "resonance"} | {name: getattr(line, name) for name in names}
        if len(line.direction) == 2:
            content["direction_deg"] = float(np.degrees(np.arctan2(*line.direction[::-1])))
        if error_hz is not None:
            content["frequency_error_hz"] = error_hz
        if motions:
            content["accelerometers"] = {
                name: {"motion_nm_per_nm": motion.size, "phase_deg": motion.phase_deg}
                for name, motion in motions.items()
            }
        sections.append(TrueVibrationSection(**content))
    return sections


def move(config: Config, values: Mapping[str, float]) -> Config:
    """Return the configuration with knobs at other values; ConfigError where they do not fit."""
    settings = config.settings
    for knob in list_knobs(config):
        if knob.key in values:
            settings = knob.edit(settings, min(max(values[knob.key], knob.low), knob.high))
    content = settings.model_dump(exclude_unset=True)
    return build_config(validate_sections(FileSection, content, config.source), config.source)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """What the page shows of a design; nan in an unstable loop."""

    curves: Mapping[str, Curve]  # by the titles of figures; none of an error without an estimate
    residual_nm: float = np.nan  # this and what follows: where the true lines are now
    strehl: float = np.nan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """What a method and sliders give; the first of the designs on show is its own."""

    config: Config
    request: DesignRequest
    moves: str  # the sliders that were moved, as people read them
    shift_hz: float  # by which the true lines have moved from where they are at the start
    designs: Designs
    shown: Mapping[str, Shown]

    @property
    def name(self) -> str:
        """Name of the design."""
        return next(iter(self.designs))

    @property
    def design(self) -> Design:
        """The design of the method where the sliders are."""
        return self.designs[self.name]

    @property
    def is_whole(self) -> bool:
        """Whether the Strehl ratios are computed."""
        return STREHL in self.shown[self.name].curves


def new_view(
    start: Config, designs: Designs, method: str = "", values: Mapping[str, float] | None = None
) -> View:
    """Design, and return the curves of the loop of the design and of those to compare with."""
    name, moved = method or default_method(), values or {}
    config = move(start, moved)
    request = design_request(name, method_named(name).reference_options)
    design, label = config.design(request), request.method.label
    if label in designs:
        label += " by the sliders"
    moves = (
        f"{knob.label} {moved[knob.key] * factor:.4g} {unit}".rstrip()
        for knob in list_knobs(start)
        if knob.key in moved
        for unit, factor in (shown_unit(knob.unit),)
    )
    every = {label: design, **designs}
    return View(
        config=config,
        request=request,
        moves=", ".join(moves),
        shift_hz=moved.get(SHIFT, 0.0),
        designs=every,
        shown={title: Shown(curves=loop_curves(one, config)) for title, one in every.items()},
    )


def whole_view(view: View, start: Config) -> View:
    """Return a view with what its designs leave, too, which takes longer than their curves."""
    if view.is_whole:
        return view
    truth, gain = view.config.truth, view.config.truth.sensor_gain
    # the true lines have moved by a shift from where they are at the start, and move on
    lines = {name: getattr(start.truth, name) for name in ("vibrations", "frequency_errors_hz")}
    low, high = frequency_errors(start)[[0, -1]]
    shifts = np.unique([*np.linspace(low, high, _SHIFTS), view.shift_hz])
    now, shown = int(np.searchsorted(shifts, view.shift_hz)), dict[str, Shown]()
    for name, design in view.designs.items():
        image = robustness_map(
            design,
            replace(truth, **lines),
            view.config.imaging,
            hardware=view.config.hardware,
            errors_hz=shifts,
            sensor_gains=[gain],
        )
        shown[name] = Shown(
            curves={**view.shown[name].curves, STREHL: (shifts, 100 * image.strehl[0, 0])},
            residual_nm=float(image.residual_nm[0, 0, now]),
            strehl=float(image.strehl[0, 0, now]),
        )
    return replace(view, shown=shown)


# The figures of the page: what is on their axes, with units of wavefronts in braces; scales over
# frequency are logarithmic
FIGURES = {
    "Rejection": ("frequency [Hz]", "\u03c3\u0304, phase to residual [-]"),
    "Noise": ("frequency [Hz]", "\u03c3\u0304, noise to residual [-]"),
    "Residual spectrum": ("frequency [Hz]", "power spectrum [{nm²/Hz}]"),
    STREHL: ("frequency error [Hz]", "Strehl ratio [%]"),
    "Estimation error": ("frequency [Hz]", "\u03c3\u0304, disturbances to error [{nm}]"),
}
# Frequencies of a curve, in all and on each side of a line, and shifts of the true lines: as many
# as a page draws in a tenth of a second
_POINTS, _NEAR_A_LINE, _SHIFTS = 240, 28, 15


def loop_curves(design: Design, config: Config) -> dict[str, Curve]:
    """Return the curves over frequency of a design in the loop of a configuration."""
    hardware, truth, n = config.hardware, config.truth, config.hardware.modes
    loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    density = {"points": _POINTS, "near": _NEAR_A_LINE}
    f = frequency_grid(hardware.frame_rate_hz, truth.lines_hz, **density)
    rejection = noise = power = np.full(f.size, np.nan)
    if loop.is_stable:
        power = shown_unit("nm²/Hz")[1] * exact_spectrum(loop, truth, f, SEGMENT)
        response = loop.system.frequency_response(f)[:, :n]
        rejection, noise = (spectral_norms(response[..., s]) for s in (np.s_[:n], np.s_[n:]))
    curves = {"Rejection": (f, rejection), "Noise": (f, noise), "Residual spectrum": (f, power)}
    if design.is_estimator:
        error = spectral_norms(design.error_system().frequency_response(f))
        curves["Estimation error"] = f, shown_unit("nm")[1] * error
    return curves


def explored_table(shown: Mapping[str, Shown]) -> Table:
    """Return what designs leave; an unstable loop has no numbers."""
    rows = [
        facts(
            design=fact(name, "design"),
            residual=fact(one.residual_nm, "residual", unit="nm", format=".1f", missing="unstable"),
            strehl=fact(one.strehl, "Strehl ratio", unit="%", scale=100, format=".2f"),
        )
        for name, one in shown.items()
    ]
    return row_table("", rows)


def judge(view: View) -> str:
    """Return the verdict on the design of a view, in sentences."""
    config = view.config
    compared = compare_in_truth({view.name: view.design}, config)
    row, *others = compared.rows
    gain = config.truth.sensor_gain
    if not row.stable:
        ends = stable_sensor_gains(config.hardware, view.design.controller)
        low, high, real = (f"{config.sensor_gain * factor:.4g}" for factor in (*ends, gain))
        return (
            f"{view.name} is stable at sensor gains of {low} to {high}; at {real} this loop is "
            "UNSTABLE."
        )
    margins = loop_margins(close_loop(config.hardware, view.design.controller, sensor_gain=gain))
    sentences = [f"WARNING: {fragility}" for fragility in margins.fragilities]
    sentences.append(say_residual(view.name, row, compared.limit))
    best = min(others, key=lambda other: other.residual_nm, default=row)
    if best.residual_nm < row.residual_nm:
        sentences.append(say_residual(f"Here {best.design}", best, None))
    checks = f"Certified: {count_text(len(view.design.certificate.checks), 'check')} passed."
    warnings = (f"{text[0].upper()}{text[1:]}." for text in compared.warnings[view.name])
    return " ".join([*sentences, f"It {margins.survival}", *warnings, checks])


def save_view(start: Config, view: View, folder: Path) -> tuple[list[Path], tuple[str, ...]]:
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
    head = f"{start.source.name!a} with {moves}; {creator_name()}"
    text = config_text(view.config.settings, {"": "\n".join((head, *commands))})
    write_atomically(config, text.encode())
    save_gain(gain, view.design)
    return [config, gain], commands


_QUICK_S = 0.3  # a design that takes longer is made when a slider is released
_TICK_MS = 1  # moves that wait while a design is made become one wish


def new_panel(title: str) -> tuple[Any, ColumnDataSource, ColumnDataSource]:
    """Return a figure with the data of its curves, and of the rules across them."""
    scale = "log" if FIGURES[title][0] == "frequency [Hz]" else "linear"
    curves = ColumnDataSource({name: [] for name in ("x", "y", "name", "colour", "dash")})
    rules = ColumnDataSource({"at": []})
    figure = new_figure(
        name=title,
        title=title,
        height=300,
        sizing_mode="stretch_width",
        x_axis_type=scale,
        y_axis_type=scale,
        tools="box_zoom,pan,wheel_zoom,reset",
    )
    # a finger scrolls the page
    figure.toolbar.update(logo=None, active_drag=None, active_scroll=None)
    units = {unit: shown_unit(unit)[0] for unit in ("nm", "nm²/Hz")}
    for axis, text in zip((figure.xaxis[0], figure.yaxis[0]), FIGURES[title], strict=True):
        axis.axis_label = PlainText(text=text.format_map(units))
    figure.vspan(x="at", source=rules, line_color=GREY, line_dash="dotted")
    look: dict[str, Any] = {"line_color": "colour", "line_dash": "dash"}
    if title == next(iter(FIGURES)):  # the others draw designs alike; a legend takes 2 ms a move
        legend = Legend(orientation="horizontal", padding=0, border_line_color=None)
        figure.add_layout(legend, "below")
        look["legend_field"] = "name"
    lines = figure.multi_line("x", "y", line_width=2, source=curves, **look)
    tips = [("", "@name"), ("x", "$snap_x"), ("y", "$snap_y")]
    figure.add_tools(HoverTool(renderers=[lines], tooltips=tips))
    return figure, curves, rules


class Session:
    """One open page."""

    def __init__(
        self,
        document: Any,
        start: Config,
        designs: Designs,
        first: View,
        folder: Path,
        saved: list[Path],
    ) -> None:
        self._document, self._start, self._designs, self._view = document, start, designs, first
        self._folder, self._saved = folder, saved  # the files that all pages wrote
        self._seconds: dict[str, float] = {}  # of the last design of a method
        self._waits = self._judges = False  # whether a wish waits, and for a verdict, too
        self._kept: dict[str, Shown] = {}
        self._sliders = {knob: _new_slider(knob) for knob in list_knobs(start)}
        methods = [(m.name, m.title) for m in METHODS.values() if not m.of_record]
        self._method = Select(
            name="method", title="Method", value=default_method(), options=methods
        )
        self._verdict, self._files = (
            Div(name=name, sizing_mode="stretch_width") for name in ("verdict", "saved")
        )
        self._table = PreText(name="table")
        self._panels = {title: new_panel(title) for title in FIGURES}
        buttons = [Button(name=label.lower(), label=label) for label in ("Keep", "Save", "Reset")]
        for button, action in zip(buttons, (self._keep, self._save, self._reset), strict=True):
            button.on_click(action)
        self._method.on_change("value", self._released)
        for slider in self._sliders.values():
            slider.on_change("value", self._moved)
            slider.on_change("value_throttled", self._released)
        controls = column(
            self._method, *self._sliders.values(), row(*buttons), self._files, width=320
        )
        figures = grid([figure for figure, *_ in self._panels.values()], ncols=2)
        figures.sizing_mode = "stretch_width"
        wide = {"sizing_mode": "stretch_width"}
        results = column(self._verdict, self._table, figures, **wide)
        document.add_root(row(controls, results, **wide))
        document.title = f"Explore {start.source.name}"
        self._show()
        self._say(self._verdict, judge(first))

    def _moved(self, attr: str, old: Any, new: Any) -> None:
        """Design anew while a slider moves, unless the method is slow."""
        if self._seconds.get(self._method.value, 0.0) < _QUICK_S:
            self._ask(judges=False)

    def _released(self, attr: str, old: Any, new: Any) -> None:
        """Design anew, and say what to think of it."""
        self._ask(judges=True)

    def _ask(self, *, judges: bool) -> None:
        """Design anew soon."""
        self._judges |= judges
        if not self._waits:
            self._waits, self._verdict.text = True, "Designing …"
            self._document.add_timeout_callback(self._design, _TICK_MS)

    def _design(self) -> None:
        """Design where the sliders stand; the curves stay those of the last design that worked."""
        judges, self._judges, self._waits = self._judges, False, False
        values = {
            knob.key: slider.value / shown_unit(knob.unit)[1]
            for knob, slider in self._sliders.items()
            if slider.value != _new_slider(knob).value
        }
        begun = time.perf_counter()
        try:
            self._view = new_view(self._start, self._designs, self._method.value, values)
            self._seconds[self._method.value] = time.perf_counter() - begun
            self._show([title for title in FIGURES if title != STREHL])
        except Exception as error:
            judges = False
            self._say(self._verdict, str(error) or repr(error))
        finish = partial(self._finish, judges=judges)
        self._document.add_timeout_callback(finish, _TICK_MS)

    def _finish(self, *, judges: bool) -> None:
        """Show what the designs leave, and say what to think of it, unless a new wish waits."""
        if self._waits:
            self._judges |= judges
            return
        try:
            self._view = whole_view(self._view, self._start)
            self._show([STREHL])
            if judges:
                self._say(self._verdict, judge(self._view))
        except Exception as error:
            self._say(self._verdict, str(error) or repr(error))

    @staticmethod
    def _say(place: Div, *lines: str) -> None:
        """Write lines of plain text."""
        place.update(text="\n".join(lines), disable_math=True, render_as_text=True)

    def _show(self, titles: Collection[str] = FIGURES) -> None:
        """Show the view and what was kept, each design in the look of its place."""
        view, shown = self._view, {**self._view.shown, **self._kept}
        for title in titles:
            _, curves, rules = self._panels[title]
            over_frequency = FIGURES[title][0] == "frequency [Hz]"
            lines_hz = view.config.truth.lines_hz if over_frequency else []
            if list(rules.data["at"]) != lines_hz:
                rules.data = {"at": np.array(lines_hz)}
            drawn = {
                name: (look, *one.curves[title])
                for look, (name, one) in enumerate(shown.items())
                if title in one.curves
            }
            curves.data = {
                "x": [x for _, x, _ in drawn.values()],
                "y": [np.where(y > 0, y, np.nan) for *_, y in drawn.values()],
                "name": list(drawn),
                "colour": [colour(look) for look, *_ in drawn.values()],
                "dash": [dashes(look) for look, *_ in drawn.values()],
            }
        if STREHL in titles:
            self._table.text = "\n".join(text_lines(explored_table(shown), 100))

    def _keep(self) -> None:
        """Keep the curves of the design that is shown."""
        self._view = view = whole_view(self._view, self._start)
        self._kept[f"{view.name}, {view.moves or 'kept'}"] = view.shown[view.name]
        self._show()

    def _save(self) -> None:
        """Write the view, and say how the files are made."""
        try:
            paths, commands = save_view(self._start, self._view, self._folder)
        except LbtSynthError as error:
            self._say(self._files, str(error))
            return
        self._saved.extend(paths)
        names = ", ".join(map(str, paths))
        self._say(self._files, f"Written: {names}. The commands that make them:", *commands)

    def _reset(self) -> None:
        """Put the sliders back, and drop the curves that were kept."""
        self._kept.clear()
        for knob, slider in self._sliders.items():
            slider.value = _new_slider(knob).value
        self._ask(judges=True)


def _new_slider(knob: Knob) -> Slider:
    """Return the slider of a knob, in the unit that is shown."""
    unit, factor = shown_unit(knob.unit)
    low, high, value = (factor * number for number in (knob.low, knob.high, knob.value))
    title = f"{knob.label} [{unit}]" if unit else knob.label
    words = {"name": knob.key, "title": title, "format": "0.[0000]"}
    return Slider(start=low, end=high, value=value, step=(high - low) / 200, **words)


def serve(
    start: Config,
    designs: Designs,
    folder: Path,
    *,
    host: str,
    port: int,
    origins: Sequence[str],
    announce: Callable[[str], None],
) -> list[Path]:
    """Serve the page until it is interrupted, and return the files that its users saved.

    ``origins`` are further addresses, as host:port, under which browsers may reach the page.
    ProblemError if a design does not fit the loop, or if there is no such place to serve.
    """
    for name, design in designs.items():
        require_compatible(name, design, start.hardware)
    first, saved = whole_view(new_view(start, designs), start), list[Path]()
    names = dict.fromkeys(("0.0.0.0", "::"), socket.gethostname()) | {"::1": "localhost"}
    name, place = names.get(host, host), port
    try:
        for family, *_, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            with socket.create_server((address[0], place), family=family) as probe:
                place = probe.getsockname()[1]
        hosts = (f"{one}:{place}" for one in ("localhost", "127.0.0.1", name))
        server = Server(
            {"/": lambda document: Session(document, start, designs, first, folder, saved)},
            address=host,
            port=place,
            allow_websocket_origin=[*hosts, *origins],
        )
    except (OSError, ValueError) as error:  # a name of another alphabet, or too long
        reason = getattr(error, "strerror", None) or str(error)
        raise ProblemError(
            f"cannot serve at --host {host} --port {port}: {reason}. Try another one; --port 0 is "
            "any that is free."
        ) from error
    server.start()
    try:
        announce(f"http://{name}:{place}/")
        server.io_loop.start()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()
    return saved
