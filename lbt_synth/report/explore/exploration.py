"""What can be moved on the page of sliders, and from there to what it shows: pure functions.

A knob edits numbers of the configuration, so that whatever is seen can be saved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.schema import FileSection
from lbt_synth.design import Design
from lbt_synth.linear import hinf_norm
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.methods.method import Method
from lbt_synth.methods.registry import METHODS, default_method, design_title, method_named
from lbt_synth.methods.request import DesignRequest, design_request
from lbt_synth.models import Vibration
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.report.designs.report import frequency_errors, require_compatible
from lbt_synth.report.figures.loops import FAR, frequency_grid
from lbt_synth.report.figures.records import SEGMENT, exact_spectrum
from lbt_synth.storage.display_unit import nm_text, shown_unit
from lbt_synth.storage.rows import fact, facts, row_table
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text
from lbt_synth.studies import robustness_map
from lbt_synth.studies.limits import compare_in_truth
from lbt_synth.validation import ComplexArray, FloatArray

Content: TypeAlias = dict[str, Any]  # of a configuration file
# puts a value into a file, given the factor on what it was
Edit: TypeAlias = Callable[[Config, Content, float, float], None]
Curve: TypeAlias = tuple[FloatArray, FloatArray]  # abscissae and ordinates, in units that are shown
SHIFT = "shift"  # key of the knob that moves the true lines
_WIDEST_HZ = 4.0  # half width of a band: telescopes drift by less in a night


@dataclass(frozen=True, slots=True)
class Knob:
    """One number that can be moved."""

    key: str
    label: str
    unit: str  # empty for a pure number
    low: float
    high: float
    value: float  # where it stands before it is moved
    edit: Edit  # what puts its value into a configuration
    log: bool = False  # whether equal steps are equal factors
    methods: frozenset[str] | None = None  # whose designs alone it changes; None: it is the loop's

    @property
    def shown(self) -> tuple[str, float]:
        """The unit that people see, and the factor to it."""
        return shown_unit(self.unit)

    def acts_on(self, method: str) -> bool:
        """Whether it changes the designs of a method."""
        return self.methods is None or method in self.methods


def list_knobs(config: Config) -> tuple[Knob, ...]:
    """Return what can be moved in a configuration: the loop and the sky, then the design."""
    return (*_loop_knobs(config), *_model_knobs(config), *_method_knobs(config))


def _loop_knobs(config: Config) -> Iterator[Knob]:
    """Yield the knobs of what the real loop meets."""
    delay, gain = config.settings.loop.delay_frames, config.truth.sensor_gain * config.sensor_gain
    edit, most = _scaled("loop", "delay_frames", default=delay), max(6.0, delay)
    yield Knob("delay", "total delay", "frames", 1.0, most, delay, edit)
    edit = _scaled("truth", "sensor_gain", default=1.0)
    yield Knob("gain", "real sensor gain", "", gain / 5, 2.5 * gain, gain, edit)
    noise_nm = float(np.sqrt(np.mean(np.square(config.noise_nm))))
    if noise_nm > 0:
        yield _factor_knob("noise", "measurement noise", "nm", noise_nm, 10.0, _scale_noise)
    low, high = frequency_errors(config)[[0, -1]].tolist()
    if low < high:
        label = "frequency error, true less assumed"
        yield Knob(SHIFT, label, "Hz", low, high, 0.0, _set_shift)
    air = config.settings.atmosphere
    for key, label, unit, name in (
        ("seeing", "seeing", "arcsec", "seeing_arcsec"),
        ("wind", "wind speed", "m/s", "wind_speed_m_s"),
    ):
        if air is not None:
            value = float(getattr(air, name))
            edit = _scaled("atmosphere", name, default=value)
            yield _factor_knob(key, label, unit, value, 4.0, edit)


def _factor_knob(key: str, label: str, unit: str, value: float, factor: float, edit: Edit) -> Knob:
    """Return a knob that reaches from its value by a factor to both sides."""
    return Knob(key, label, unit, value / factor, value * factor, value, edit, log=True)


def _model_knobs(config: Config) -> Iterator[Knob]:
    """Yield the knobs of the lines that filters assume."""
    lines = config.settings.model.vibrations
    if not lines:
        return
    filters = [method for method in METHODS.values() if method.estimator]
    methods = frozenset(method.name for method in filters)
    damping = float(np.exp(np.mean(np.log([line.damping for line in lines]))))
    knob = _factor_knob("damping", "assumed damping", "", damping, 10.0, _scale_damping)
    yield replace(knob, high=min(knob.high, 0.9), methods=methods)
    reach = min(_WIDEST_HZ, *(0.9 * line.frequency_hz for line in lines))
    value = min(reach, *(line.spread_hz or 0.0 for line in lines))
    methods = frozenset(method.name for method in filters if not method.needs_options)
    label = "half width of assumed bands"
    yield Knob("spread", label, "Hz", 0.0, reach, value, _set_spread, methods=methods)


def _method_knobs(config: Config) -> Iterator[Knob]:
    """Yield the knobs of single methods: of the section ``design`` of a configuration."""
    ratio = float(config.settings.design.gamma_ratio)
    edit = _scaled("design", "gamma_ratio", default=ratio)
    bounded = frozenset(name for name, m in METHODS.items() if "gamma_ratio" in m.configurable)
    yield Knob("gamma_ratio", "gamma ratio", "", 1.0, 3.0, ratio, edit, methods=bounded)
    for name, method in METHODS.items():
        section, methods = section_of(method, config), frozenset({name})
        if getattr(section, "bands", None):
            margin = float(section.modulus_margin)
            edit = _scaled("design", name, "modulus_margin", default=margin)
            yield Knob("modulus", "modulus margin", "", 0.2, 0.8, margin, edit, methods=methods)
            half = float(np.mean([band.high_hz - band.low_hz for band in section.bands])) / 2
            edit, label = partial(_scale_bands, name), "half width of the bands"
            knob = _factor_knob("band", label, "Hz", half, 10.0, edit)
            yield replace(knob, high=max(_WIDEST_HZ, half), methods=methods)


def section_of(method: Method, config: Config) -> Any:
    """Return a method's section of a configuration, else one made for its plant; None if none."""
    section = config.method_section(method.name)
    if section is None and method.plant_section is not None and config.plant.vibrations:
        section = method.plant_section(config.plant)
    return section


def _scaled(*keys: str, default: float) -> Edit:
    """Return the edit of the number at a path of keys, or of a list, which keeps proportions."""

    def edit(_: Config, content: Content, value: float, factor: float) -> None:
        for key in keys[:-1]:
            content = content.setdefault(key, {})
        numbers = np.asarray(content.get(keys[-1], default)) * factor
        # the value of the slider, and not a neighbour by rounding
        content[keys[-1]] = np.vectorize(lambda number: float(f"{number:.12g}"))(numbers).tolist()

    return edit


def _scale_noise(config: Config, content: Content, value: float, factor: float) -> None:
    """Scale the noise of all measurements."""
    sensor = content["sensor"]
    for name in ("noise_mas", "pyramid"):
        sensor.pop(name, None)
    sensor["noise_nm"] = (factor * np.asarray(config.noise_nm)).tolist()


def _set_shift(config: Config, content: Content, value: float, factor: float) -> None:
    """Move the true lines, the one that moves most by a shift; those of the model stay."""
    for line in _true_lines(config, content):
        place_hz = line["frequency_hz"]
        percent = line.pop("frequency_error_percent", None)
        if percent is not None:
            line["frequency_error_hz"] = place_hz * percent / 100  # so that it stays as it is
        line["frequency_hz"] += config.truth.frequency_shift_hz(place_hz, value)


def _scale_damping(config: Config, content: Content, value: float, factor: float) -> None:
    """Scale the damping of the lines of the model; those of the truth stay."""
    _true_lines(config, content)
    for line in content["model"]["vibrations"]:
        if line["damping"] < 0.99:  # from there on it is a drift
            line["damping"] = min(line["damping"] * factor, 0.99)


def _set_spread(config: Config, content: Content, value: float, factor: float) -> None:
    """Spread the lines of the model over bands of a half width; those of the truth stay."""
    _true_lines(config, content)
    for line in content["model"]["vibrations"]:
        if value > 0:
            line["spread_hz"] = value
        else:
            line.pop("spread_hz", None)
            line.pop("lines", None)


def _scale_bands(
    method: str, config: Config, content: Content, value: float, factor: float
) -> None:
    """Scale the half widths of the bands of a method's section; their middles stay."""
    highest = config.hardware.frame_rate_hz / 2
    for band in content["design"][method]["bands"]:
        middle = (band["low_hz"] + band["high_hz"]) / 2
        half = factor * (band["high_hz"] - band["low_hz"]) / 2
        band |= {"low_hz": max(middle - half, 0.0), "high_hz": min(middle + half, highest)}


def _true_lines(config: Config, content: Content) -> list[Content]:
    """Return the lines of the truth; those that it takes from the model become its own."""
    truth = content.setdefault("truth", {})
    if not isinstance(truth.get("vibrations", []), list):
        lines = stationary_vibrations(config.truth.vibrations)
        errors = config.truth.frequency_errors_hz or (None,) * len(lines)
        entries = truth["vibrations"] = []
        for line, error in zip(lines, errors, strict=True):
            if not isinstance(line, Vibration):
                continue
            names = ("frequency_hz", "damping", "rms_nm")
            entry = {"kind": "resonance", **{n: float(getattr(line, n)) for n in names}}
            if len(line.direction) == 2:
                entry["direction_deg"] = float(np.degrees(np.arctan2(*line.direction[::-1])))
            entries.append(entry if error is None else {**entry, "frequency_error_hz": error})
    return truth.setdefault("vibrations", [])  # type: ignore[no-any-return]  # of a file


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """What the page shows of a design; nan in an unstable loop."""

    curves: Mapping[str, Curve]  # by the keys of figures; none of an error without an estimate
    residual_nm: float  # this and what follows: where the true lines are now
    strehl: float
    modulus: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exploration:
    """A configuration, designs to compare with, and what can be moved."""

    config: Config
    designs: Mapping[str, Design]
    knobs: tuple[Knob, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """What a method and sliders give; the first of the designs on show is its own."""

    config: Config
    request: DesignRequest
    moves: str  # the sliders that were moved, as people read them
    shift_hz: float  # of the true lines
    design: Design
    shown: Mapping[str, Shown]

    @property
    def name(self) -> str:
        """Name of the design."""
        return next(iter(self.shown))


def explore(config: Config, designs: Mapping[str, Design]) -> Exploration:
    """Return what can be explored; ProblemError for a design that does not fit the loop."""
    for name, design in designs.items():
        require_compatible(name, design, config.hardware)
    return Exploration(config=config, designs=designs, knobs=list_knobs(config))


def moved_knobs(
    exploration: Exploration, method: str, values: Mapping[str, float]
) -> dict[Knob, float]:
    """Return the knobs that were moved and act on the designs of a method, with values in reach."""
    return {
        knob: min(max(float(values[knob.key]), knob.low), knob.high)
        for knob in exploration.knobs
        if knob.key in values and knob.acts_on(method)
    }


def move(config: Config, method: str, moved: Mapping[Knob, float]) -> Config:
    """Return the configuration with knobs at other values; ConfigError where they do not fit."""
    content = config.settings.model_dump(exclude_unset=True)
    section = section_of(method_named(method), config)
    if section is not None and content.setdefault("design", {}).get(method) is None:
        content["design"][method] = section.model_dump(exclude_unset=True)  # made for its plant
    for knob, value in moved.items():
        knob.edit(config, content, value, value / knob.value if knob.value else 1.0)
    return build_config(validate_sections(FileSection, content, config.source), config.source)


def new_view(
    exploration: Exploration,
    method: str | None = None,
    values: Mapping[str, float] = MappingProxyType({}),
) -> View:
    """Design, and return what the page shows of the design and of those to compare with."""
    name = method or default_method()
    moved = moved_knobs(exploration, name, values)
    config = move(exploration.config, name, moved)
    request = design_request(name, method_named(name).reference_options)
    design, label = config.design(request), request.method.label
    if label in exploration.designs:
        label += " by the sliders"
    shift_hz = next((value for knob, value in moved.items() if knob.key == SHIFT), 0.0)
    moves = (
        f"{knob.label} {value * knob.shown[1]:.4g} {knob.shown[0]}".rstrip()
        for knob, value in moved.items()
    )
    return View(
        config=config,
        request=request,
        moves=", ".join(moves),
        shift_hz=shift_hz,
        design=design,
        shown={
            title: show_design(one, config, exploration.config, shift_hz)
            for title, one in {label: design, **exploration.designs}.items()
        },
    )


# Frequencies of a curve, in all and on each side of a line, and shifts of the true lines: as many
# as a page draws in a tenth of a second
_POINTS, _NEAR_A_LINE, _SHIFTS = 240, 28, 15


def show_design(design: Design, config: Config, start: Config, shift_hz: float) -> Shown:
    """Return what a design does in the loop of a configuration.

    The true lines have moved there by a shift from where they are at the start, and move on for the
    Strehl ratio over their shift.
    """
    hardware, truth = config.hardware, config.truth
    loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    density = {"points": _POINTS, "near": _NEAR_A_LINE}
    grid = frequency_grid(hardware.frame_rate_hz, truth.lines_hz, **density)
    n, m = hardware.modes, hardware.n_commands
    response = loop.system.frequency_response(grid)
    lines = {name: getattr(start.truth, name) for name in ("vibrations", "frequency_errors_hz")}
    low, high = frequency_errors(start)[[0, -1]]
    shifts = np.unique([*np.linspace(low, high, _SHIFTS), shift_hz])
    image = robustness_map(
        design,
        replace(truth, **lines),
        config.imaging,
        hardware=hardware,
        errors_hz=shifts,
        sensor_gains=[truth.sensor_gain],
    )
    poles, gains = loop.system.poles, _loop_gains(response[:, n + m :, n:])
    modulus, power = np.nan, np.full(grid.size, np.nan)
    rejection, noise = power, power
    if loop.is_stable:
        modulus = 1 / float(hinf_norm(loop.path("noise", "reading")))
        power = shown_unit("nm²/Hz")[1] * exact_spectrum(loop, truth, grid, SEGMENT)
        rejection, noise = (spectral_norms(response[:, :n, s]) for s in (np.s_[:n], np.s_[n:]))
    curves = {
        "explore-rejection": (grid, rejection),
        "explore-noise": (grid, noise),
        "explore-nyquist": (gains.real, gains.imag),
        "explore-spectrum": (grid, power),
        "explore-strehl": (shifts, 100 * image.strehl[0, 0]),
        "explore-poles": (poles.real, poles.imag),
    }
    if design.is_estimator:
        error = spectral_norms(design.error_system().frequency_response(grid))
        curves["explore-sigma"] = grid, shown_unit("nm")[1] * error
    now = int(np.searchsorted(shifts, shift_hz))
    return Shown(
        curves=curves,
        residual_nm=float(image.residual_nm[0, 0, now]),
        strehl=float(image.strehl[0, 0, now]),
        modulus=modulus,
    )


def _loop_gains(returned: ComplexArray) -> ComplexArray:
    """Return the loop gains of all measurements, each broken in turn, with gaps between them.

    With the others closed, a response (f, m, m) from noise to measurement is 1 / (1 + gain). What
    is far outside the plane is cut, as a canvas takes no large numbers.
    """
    broken = 1 / returned.diagonal(axis1=1, axis2=2).T - 1
    near = np.clip(broken.real, -FAR, FAR) + 1j * np.clip(broken.imag, -FAR, FAR)
    return np.asarray(np.pad(near, ((0, 0), (0, 1)), constant_values=np.nan).ravel())


def explored_table(shown: Mapping[str, Shown]) -> Table:
    """Return what designs leave; an unstable loop has no numbers."""
    rows = [
        facts(
            design=fact(name, "design"),
            residual=fact(one.residual_nm, "residual", unit="nm", format=".1f", missing="unstable"),
            strehl=fact(one.strehl, "Strehl ratio", unit="%", scale=100, format=".2f"),
            modulus=fact(one.modulus, "modulus margin", format=".3f"),
        )
        for name, one in shown.items()
    ]
    return row_table("", rows)


def judge(view: View) -> str:
    """Return the verdict on the design of a view, in sentences."""
    config, controller = view.config, view.design.controller
    # the design knows the loop, but for its real sensor gain
    nominal, gain = loop_margins(close_loop(config.hardware, controller)), config.truth.sensor_gain
    low, high, now = (config.sensor_gain * g for g in (nominal.gain_low, nominal.gain_high, gain))
    checks = count_text(len(view.design.certificate.checks), "check")
    certified = f"certified ({checks}), and stable for sensor gains of {low:.3g} to {high:.3g}"
    compared = compare_in_truth({view.name: view.design}, config)
    row, *others = compared.rows
    if not row.stable:
        return f"{view.name} is {certified}; at {now:.3g} this loop is UNSTABLE."
    margins = loop_margins(close_loop(config.hardware, controller, sensor_gain=gain))
    residual, strehl = nm_text(row.residual_nm, ".1f", unit="nm rms"), 100 * row.strehl
    sentences = [f"{view.name} leaves {residual}, Strehl ratio {strehl:.1f} %"]
    if compared.limit is not None:
        above = f"{row.above_limit_percent:.1f}"
        sentences[0] += f", {above} % above the least of any linear controller"
    best = min(others, key=lambda other: other.residual_nm, default=row)
    if best.residual_nm < row.residual_nm:
        least = nm_text(best.residual_nm, ".1f")
        sentences.append(f"the {design_title(best.method)} leaves {least} here")
    sentences.append(
        f"Margins: modulus {margins.modulus:.3g}, phase {margins.phase_deg:.3g} degrees"
    )
    sentences.append(f"it {margins.survival.removesuffix('.')}")
    sentences += [f"WARNING: {text.removesuffix('.')}" for text in margins.fragilities]
    sentences += [*compared.warnings[view.name], f"it is {certified}"]
    return "".join(f"{text[0].upper()}{text[1:]}. " for text in sentences).strip()
