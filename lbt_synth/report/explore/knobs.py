"""What can be moved on the page of sliders: in which range, and what it edits in a configuration.

A method of synthesis declares the range of an option's slider beside the option, as ``slider``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.config import Config
from lbt_synth.methods.method import Method, Section
from lbt_synth.methods.registry import all_methods
from lbt_synth.models import Vibration
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.report.designs.report import frequency_errors
from lbt_synth.storage.display_unit import shown_unit

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


def list_knobs(config: Config) -> tuple[Knob, ...]:
    """Return what can be moved in a configuration: the loop and the sky, then the design."""
    own = (knob for method in all_methods().values() for knob in _method_knobs(method, config))
    return (*_loop_knobs(config), *_model_knobs(config), *own)


def shift_range_hz(config: Config) -> tuple[float, float]:
    """Return how far the true lines can be moved [Hz]: over the configuration's errors."""
    errors = frequency_errors(config)
    return float(errors[0]), float(errors[-1])


def _loop_knobs(config: Config) -> Iterator[Knob]:
    """Yield the knobs of what the real loop meets."""
    delay, gain = config.settings.loop.delay_frames, config.truth.sensor_gain * config.sensor_gain
    yield Knob(
        "delay",
        "total delay",
        "frames",
        1.0,
        max(6.0, delay),
        delay,
        _setter("loop", "delay_frames"),
    )
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
    filters = [method for method in all_methods().values() if method.estimator]
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
