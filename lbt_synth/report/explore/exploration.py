"""What can be moved on the page of sliders, and from there to what it shows: pure functions.

A method of synthesis declares the range of an option's slider beside the option, as ``slider``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.schema import FileSection
from lbt_synth.design import Design
from lbt_synth.linear import hinf_norm, largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.methods.method import Method, Section
from lbt_synth.methods.registry import METHODS, default_method, design_title, method_named
from lbt_synth.methods.request import DesignRequest, design_request
from lbt_synth.models import Vibration
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.report.designs.report import frequency_errors, require_compatible
from lbt_synth.report.figures.loops import frequency_grid
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
SHIFT = "shift"  # key of the knob that moves the true lines
_WIDEST_HZ = 4.0  # half width of a band
_NEAR = 0.9  # of its frequency, half the widest band around a line
_MOST_DAMPING = 0.99


@dataclass(frozen=True, slots=True)
class Knob:
    """One number that can be moved."""

    key: str
    label: str
    unit: str  # empty for a pure number
    low: float
    high: float
    value: float  # where it stands before it is moved
    edit: Edit | None = None  # what puts its value into a configuration, or
    option: str = ""  # the option of the method that it is
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
    own = (knob for method in METHODS.values() for knob in _method_knobs(method, config))
    return (*_loop_knobs(config), *_model_knobs(config), *own)


def shift_range_hz(config: Config) -> tuple[float, float]:
    """Return how far the true lines can be moved [Hz]: over the configuration's errors."""
    errors = frequency_errors(config)
    return float(errors[0]), float(errors[-1])


def _loop_knobs(config: Config) -> Iterator[Knob]:
    """Yield the knobs of what the real loop meets."""
    delay, gain = config.settings.loop.delay_frames, config.truth.sensor_gain * config.sensor_gain
    edit, most = _setter("loop", "delay_frames"), max(6.0, delay)
    yield Knob("delay", "total delay", "frames", 1.0, most, delay, edit)
    yield Knob("gain", "real sensor gain", "", gain / 5, 2.5 * gain, gain, _scale_sensor_gain)
    noise_nm = float(np.sqrt(np.mean(np.square(config.noise_nm))))
    if noise_nm > 0:
        yield _factor_knob("noise", "measurement noise", "nm", noise_nm, 10.0, _scale_noise)
    low, high = shift_range_hz(config)
    if low < high:
        label = "frequency error, true less assumed"
        yield Knob(SHIFT, label, "Hz", low, high, 0.0, _set_shift)
    air = config.settings.atmosphere
    if air is not None:
        for key, label, unit, name in (
            ("seeing", "seeing", "arcsec", "seeing_arcsec"),
            ("wind", "wind speed", "m/s", "wind_speed_m_s"),
        ):
            edit = _setter("atmosphere", name)
            yield _factor_knob(key, label, unit, getattr(air, name), 4.0, edit)


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
    reach = min(_WIDEST_HZ, *(_NEAR * line.frequency_hz for line in lines))
    value = min(reach, *(line.spread_hz or 0.0 for line in lines))
    methods = frozenset(method.name for method in filters if not method.needs_options)
    label = "half width of assumed bands"
    yield Knob("spread", label, "Hz", 0.0, reach, value, _set_spread, methods=methods)


def _method_knobs(method: Method, config: Config) -> Iterator[Knob]:
    """Yield the knobs of what a method declares a slider for: options, and keys of its section."""
    methods, section = frozenset({method.name}), section_of(method, config)
    for name, low, high in _declared_sliders(method.options):
        option = method.options.model_fields[name]
        value = option.examples[0] if option.is_required() and option.examples else option.default
        value = float(config.design_defaults.get(name, value))
        key, label = f"{method.name}-{name}", _label(name)
        yield Knob(key, *label, low, high, value, option=name, methods=methods)
    if section is None:
        return
    for name, low, high in _declared_sliders(type(section)):
        value, edit = float(getattr(section, name)), _setter("design", method.name, name)
        key, label = f"{method.name}-{name}", _label(name)
        yield Knob(key, *label, low, high, value, edit, methods=methods)
    if getattr(section, "bands", None):
        half = float(np.mean([band.high_hz - band.low_hz for band in section.bands])) / 2
        edit = partial(_scale_bands, method.name)
        key, words = f"{method.name}-band", "half width of the bands"
        knob = _factor_knob(key, words, "Hz", half, 10.0, edit)
        yield replace(knob, high=max(_WIDEST_HZ, half), methods=methods)


def _declared_sliders(kind: type[Section]) -> Iterator[tuple[str, float, float]]:
    """Yield the fields that declare a slider, with its ends."""
    for name, field in kind.model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and isinstance(ends := extra.get("slider"), list):
            low, high = (float(str(end)) for end in ends)
            yield name, low, high


def _label(name: str) -> tuple[str, str]:
    """Return the name of an option as words, and its unit."""
    words, _, unit = name.rpartition("_")
    return (words.replace("_", " "), "Hz") if unit == "hz" else (name.replace("_", " "), "")


def section_of(method: Method, config: Config) -> Any:
    """Return a method's section of a configuration, else one made for its plant; None if none."""
    section = config.method_section(method.name)
    if section is None and method.plant_section is not None and config.plant.vibrations:
        section = method.plant_section(config.plant, None)
    return section


def _setter(*keys: str) -> Edit:
    """Return the edit that sets the number at a path of keys."""

    def edit(_: Config, content: Content, value: float, factor: float) -> None:
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value

    return edit


def _scale_sensor_gain(config: Config, content: Content, value: float, factor: float) -> None:
    """Scale the real sensor gain; gains of several measurements keep their proportions."""
    truth = content.setdefault("truth", {})
    gain = truth.get("sensor_gain", 1.0)
    truth["sensor_gain"] = [factor * g for g in gain] if isinstance(gain, list) else factor * gain


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
        if line["damping"] < _MOST_DAMPING:  # beyond, it is a drift
            line["damping"] = min(line["damping"] * factor, _MOST_DAMPING)


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


_POINTS, _NEAR_A_LINE = 240, 28  # frequencies of a curve: in all, and on each side of a line
_SHIFTS = 15  # of the true lines, for which a Strehl ratio is computed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """What the page shows of a design; nan in an unstable loop."""

    frequency_hz: FloatArray  # (f,)
    error_nm: FloatArray | None  # (f,): norm of the estimation error; None without an estimate
    rejection: FloatArray  # (f,): norm from phase to residual
    noise_transfer: FloatArray  # (f,): norm from noise to residual
    spectrum_nm2_hz: FloatArray  # (f,): of the residual, sum over the axes
    broken: ComplexArray  # (q, f): loop gain of each measurement, the others closed
    poles: ComplexArray  # of the closed loop
    shift_hz: FloatArray  # (s,): by which the true lines are moved from the start
    strehls: FloatArray  # (s,): Strehl ratio there, in [0, 1]
    # where the true lines are now
    residual_nm: float
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

    values: Mapping[str, float]  # of the knobs that were moved, by their keys
    config: Config
    request: DesignRequest
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
    method: str, values: Mapping[str, float], knobs: Sequence[Knob]
) -> dict[Knob, float]:
    """Return the knobs that were moved and act on the designs of a method, with values in reach."""
    return {
        knob: min(max(float(values[knob.key]), knob.low), knob.high)
        for knob in knobs
        if knob.key in values and knob.acts_on(method)
    }


def fulfil(
    name: str, values: Mapping[str, float], knobs: Sequence[Knob], config: Config
) -> tuple[Config, DesignRequest]:
    """Return the configuration and the request of a method whose knobs were moved.

    ConfigError where they do not fit.
    """
    method, moved = method_named(name), moved_knobs(name, values, knobs)
    content = config.settings.model_dump(exclude_unset=True)
    section = None if method.section is None else section_of(method, config)
    if section is not None and content.setdefault("design", {}).get(name) is None:
        content["design"][name] = section.model_dump(exclude_unset=True)  # made for its plant
    for knob, value in moved.items():
        if knob.edit is not None:
            knob.edit(config, content, value, value / knob.value if knob.value else 1.0)
    settings = validate_sections(FileSection, content, config.source)
    options = {
        knob.option: moved.get(knob, knob.value)
        for knob in knobs
        if knob.option and name in (knob.methods or ())
    }
    request = design_request(name, {**method.reference_options, **options})
    return build_config(settings, config.source), request


def new_view(
    exploration: Exploration,
    method: str | None = None,
    values: Mapping[str, float] = MappingProxyType({}),
) -> View:
    """Design, and return what the page shows of the design and of those to compare with."""
    name, knobs = method or default_method(), exploration.knobs
    config, request = fulfil(name, values, knobs, exploration.config)
    shifts = (v for knob, v in moved_knobs(name, values, knobs).items() if knob.key == SHIFT)
    design, label, shift_hz = config.design(request), request.method.label, next(shifts, 0.0)
    if label in exploration.designs:
        label += " by the sliders"
    return View(
        values=values,
        config=config,
        request=request,
        shift_hz=shift_hz,
        design=design,
        shown={
            name: show_design(each, config, exploration.config, shift_hz)
            for name, each in {label: design, **exploration.designs}.items()
        },
    )


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
    returned = response[:, n + m :, n:].diagonal(axis1=1, axis2=2).T
    stable, nothing = loop.is_stable, np.full(grid.size, np.nan)
    lines = {name: getattr(start.truth, name) for name in ("vibrations", "frequency_errors_hz")}
    shifts = np.unique(np.append(np.linspace(*shift_range_hz(start), _SHIFTS), shift_hz))
    image = robustness_map(
        design,
        replace(truth, **lines),
        config.imaging,
        hardware=hardware,
        errors_hz=shifts,
        sensor_gains=[truth.sensor_gain],
    )
    now = int(np.searchsorted(shifts, shift_hz))
    return Shown(
        frequency_hz=grid,
        error_nm=largest_singular_values(design.error_system(), grid)
        if design.is_estimator
        else None,
        rejection=spectral_norms(response[:, :n, :n]) if stable else nothing,
        noise_transfer=spectral_norms(response[:, :n, n:]) if stable else nothing,
        spectrum_nm2_hz=exact_spectrum(loop, truth, grid, SEGMENT) if stable else nothing,
        broken=1 / returned - 1,
        poles=loop.system.poles,
        shift_hz=shifts,
        strehls=image.strehl[0, 0],
        residual_nm=float(image.residual_nm[0, 0, now]),
        strehl=float(image.strehl[0, 0, now]),
        modulus=1 / float(hinf_norm(loop.output_sensitivity())) if stable else np.nan,
    )


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


def describe_moves(exploration: Exploration, view: View) -> str:
    """Return the sliders that were moved for a view, as people read them; empty without any."""
    moved = moved_knobs(view.request.method.name, view.values, exploration.knobs)
    return ", ".join(
        f"{knob.label} {value * knob.shown[1]:.4g} {knob.shown[0]}".rstrip()
        for knob, value in moved.items()
    )


def judge(view: View) -> str:
    """Return the verdict on the design of a view, in sentences."""
    config, controller = view.config, view.design.controller
    # the design knows the loop, but for its real sensor gain
    nominal, gain = loop_margins(close_loop(config.hardware, controller)), config.truth.sensor_gain
    low, high, now = (config.sensor_gain * g for g in (nominal.gain_low, nominal.gain_high, gain))
    checks = count_text(len(view.design.certificate.checks), "check")
    certified = f"certified ({checks}), and stable for sensor gains of {low:.3g} to {high:.3g}"
    compared = compare_in_truth({view.name: view.design}, config)
    own, *others = compared.rows
    if not own.stable:
        return f"{view.name} is {certified}; at {now:.3g} this loop is UNSTABLE."
    margins = loop_margins(close_loop(config.hardware, controller, sensor_gain=gain))
    residual, strehl = nm_text(own.residual_nm, ".1f", unit="nm rms"), 100 * own.strehl
    sentences = [f"{view.name} leaves {residual}, Strehl ratio {strehl:.1f} %"]
    if compared.limit is not None:
        above = f"{own.above_limit_percent:.1f}"
        sentences[0] += f", {above} % above the least of any linear controller"
    best = min(others, key=lambda row: row.residual_nm, default=own)
    if best.residual_nm < own.residual_nm:
        least = nm_text(best.residual_nm, ".1f")
        sentences.append(f"the {design_title(best.method)} leaves {least} here")
    sentences.append(
        f"Margins: modulus {margins.modulus:.3g}, phase {margins.phase_deg:.3g} degrees"
    )
    sentences.append(f"it {margins.survival.removesuffix('.')}")
    sentences += [f"WARNING: {text.removesuffix('.')}" for text in margins.fragilities]
    sentences += [*compared.warnings[view.name], f"it is {certified}"]
    return "".join(f"{text[0].upper()}{text[1:]}. " for text in sentences).strip()
