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
Edit: TypeAlias = Callable[[Config, Content, float], None]
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
    yield Knob("delay", "total delay", "frames", 1.0, max(6.0, delay), delay, _set_delay)
    yield Knob("gain", "real sensor gain", "", gain / 5, 2.5 * gain, gain, _set_sensor_gain)
    noise_nm = _mean_noise_nm(config)
    if noise_nm > 0:
        yield _factor_knob("noise", "measurement noise", "nm", noise_nm, 10.0, _set_noise)
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
            edit = partial(_set_air, name)
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
    damping = _mean_damping(config)
    knob = _factor_knob("damping", "assumed damping", "", damping, 10.0, _set_damping)
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
        value, edit = float(getattr(section, name)), partial(_set_section_key, method, name)
        key, label = f"{method.name}-{name}", _label(name)
        yield Knob(key, *label, low, high, value, edit, methods=methods)
    if getattr(section, "bands", None):
        half, edit = _mean_half_width_hz(section), partial(_set_bands, method)
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


def section_content(method: Method, config: Config, content: Content) -> Content:
    """Return a method's section of a file, which gets the one made for its plant if need be."""
    own = content.setdefault("design", {})
    if own.get(method.name) is None:
        own[method.name] = section_of(method, config).model_dump(exclude_unset=True)
    return own[method.name]  # type: ignore[no-any-return]  # of a file


def _set_delay(_: Config, content: Content, delay_frames: float) -> None:
    content["loop"]["delay_frames"] = delay_frames


def _set_air(name: str, _: Config, content: Content, value: float) -> None:
    content["atmosphere"][name] = value


def _set_sensor_gain(config: Config, content: Content, gain: float) -> None:
    """Set the real sensor gain; gains of several measurements keep their proportions."""
    truth = content.setdefault("truth", {})
    factor = gain / (config.truth.sensor_gain * config.sensor_gain)
    truth["sensor_gain"] = _scaled(truth.get("sensor_gain", 1.0), factor)


def _set_noise(config: Config, content: Content, noise_nm: float) -> None:
    """Set the noise, the root mean square of those of several measurements."""
    sensor = content["sensor"]
    for name in ("noise_mas", "pyramid"):
        sensor.pop(name, None)
    sensor["noise_nm"] = _scaled(
        np.asarray(config.noise_nm).tolist(), noise_nm / _mean_noise_nm(config)
    )


def _scaled(value: Any, factor: float) -> Any:
    """Return a number, or each of a list, times a factor."""
    return [factor * one for one in value] if isinstance(value, list) else factor * value


def _mean_noise_nm(config: Config) -> float:
    """Return the root mean square of the noise of all measurements [nm]."""
    return float(np.sqrt(np.mean(np.square(config.noise_nm))))


def _set_shift(config: Config, content: Content, shift_hz: float) -> None:
    """Move the true lines, the one that moves most by a shift; those of the model stay."""
    for line in _true_lines(config, content):
        place_hz = line["frequency_hz"]
        percent = line.pop("frequency_error_percent", None)
        if percent is not None:
            line["frequency_error_hz"] = place_hz * percent / 100  # so that it stays as it is
        line["frequency_hz"] += config.truth.frequency_shift_hz(place_hz, shift_hz)


def _set_damping(config: Config, content: Content, damping: float) -> None:
    """Set the mean damping of the lines of the model; those of the truth stay."""
    _true_lines(config, content)
    factor = damping / _mean_damping(config)
    for line in content["model"]["vibrations"]:
        line["damping"] = min(line["damping"] * factor, _MOST_DAMPING)


def _mean_damping(config: Config) -> float:
    """Return the geometric mean of the damping of the lines of the model."""
    lines = config.settings.model.vibrations or ()
    return float(np.exp(np.mean(np.log([line.damping for line in lines]))))


def _set_spread(config: Config, content: Content, spread_hz: float) -> None:
    """Spread the lines of the model over bands of a half width; those of the truth stay."""
    _true_lines(config, content)
    for line in content["model"]["vibrations"]:
        if spread_hz > 0:
            line["spread_hz"] = spread_hz
        else:
            line.pop("spread_hz", None)
            line.pop("lines", None)


def _set_section_key(
    method: Method, name: str, config: Config, content: Content, value: float
) -> None:
    section_content(method, config, content)[name] = value


def _set_bands(method: Method, config: Config, content: Content, half_width_hz: float) -> None:
    """Set the mean half width of the bands of a method's section; their middles stay."""
    factor = half_width_hz / _mean_half_width_hz(section_of(method, config))
    highest = config.hardware.frame_rate_hz / 2
    for band in section_content(method, config, content)["bands"]:
        low, high = band["low_hz"], band["high_hz"]
        middle, half = (low + high) / 2, factor * (high - low) / 2
        band |= {"low_hz": max(middle - half, 0.0), "high_hz": min(middle + half, highest)}


def _mean_half_width_hz(section: Any) -> float:
    """Return the mean half width of the bands of a section [Hz]."""
    return float(np.mean([band.high_hz - band.low_hz for band in section.bands])) / 2


def _true_lines(config: Config, content: Content) -> list[Content]:
    """Return the lines of the truth; those that it takes from the model become its own."""
    truth = content.setdefault("truth", {})
    if not isinstance(truth.get("vibrations", []), list):
        lines = stationary_vibrations(config.truth.vibrations)
        errors = config.truth.frequency_errors_hz or (None,) * len(lines)
        truth["vibrations"] = [
            _line_content(line) | ({} if error is None else {"frequency_error_hz": error})
            for line, error in zip(lines, errors, strict=True)
            if isinstance(line, Vibration)
        ]
    return truth.setdefault("vibrations", [])  # type: ignore[no-any-return]  # of a file


def _line_content(line: Vibration) -> Content:
    """Return a resonance as the entry of a configuration."""
    names = ("frequency_hz", "damping", "rms_nm")
    entry = {"kind": "resonance", **{name: float(getattr(line, name)) for name in names}}
    if len(line.direction) == 2:
        entry["direction_deg"] = float(np.degrees(np.arctan2(line.direction[1], line.direction[0])))
    return entry
