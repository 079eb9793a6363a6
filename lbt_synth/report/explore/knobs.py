"""What can be moved on the page of sliders, and in which range.

A method of synthesis declares the range of an option's slider beside the option, as ``slider``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

from lbt_synth.config import Config
from lbt_synth.methods.method import Method, Section
from lbt_synth.methods.registry import all_methods
from lbt_synth.report.designs.report import frequency_errors
from lbt_synth.report.explore import edits
from lbt_synth.report.explore.edits import Content
from lbt_synth.storage.display_unit import shown_unit

Edit: TypeAlias = Callable[[Config, Content, float], None]
SHIFT = "shift"  # key of the knob that moves the true lines
_WIDEST_HZ = 4.0  # half width of a band
_NEAR = 0.9  # of its frequency, half the widest band around a line


@dataclass(frozen=True, slots=True, kw_only=True)
class Knob:
    """One number that can be moved."""

    key: str
    label: str
    unit: str = ""  # Its unit; empty for a pure number
    low: float
    high: float
    value: float  # Where it stands before it is moved
    log: bool = False  # Whether equal steps are equal factors
    methods: frozenset[str] | None = (
        None  # Those whose designs alone it changes; None: it is the loop's
    )
    option: str = ""  # The option of the method that it is, or
    edit: Edit | None = None  # what puts its value into a configuration

    @property
    def shown(self) -> tuple[str, float]:
        """The unit that people see, and the factor to it."""
        return shown_unit(self.unit)


def list_knobs(config: Config) -> tuple[Knob, ...]:
    """Return what can be moved in a configuration: the loop and the sky, then the design."""
    methods = all_methods().values()
    own = (knob for method in methods for knob in _method_knobs(method, config))
    return (*_loop_knobs(config), *_model_knobs(config), *own)


def shift_range_hz(config: Config) -> tuple[float, float]:
    """Return how far the true lines can be moved [Hz]: over the configuration's errors."""
    errors = frequency_errors(config)
    return float(errors[0]), float(errors[-1])


def _loop_knobs(config: Config) -> Iterator[Knob]:
    """Yield the knobs of what the real loop meets."""
    delay, gain = config.settings.loop.delay_frames, config.truth.sensor_gain * config.sensor_gain
    yield Knob(
        key="delay",
        label="total delay",
        unit="frames",
        low=1.0,
        high=max(6.0, delay),
        value=delay,
        edit=edits.set_delay,
    )
    yield Knob(
        key="gain",
        label="real sensor gain",
        low=gain / 5,
        high=2.5 * gain,
        value=gain,
        edit=edits.set_sensor_gain,
    )
    noise = edits.mean_noise_nm(config)
    if noise > 0:
        yield _factor_knob("noise", "measurement noise", "nm", noise, 10.0, edits.set_noise)
    low, high = shift_range_hz(config)
    if low < high:
        yield Knob(
            key=SHIFT,
            label="frequency error, true less assumed",
            unit="Hz",
            low=low,
            high=high,
            value=0.0,
            edit=edits.set_shift,
        )
    air = config.settings.atmosphere
    if air is not None:
        yield _factor_knob("seeing", "seeing", "arcsec", air.seeing_arcsec, 4.0, edits.set_seeing)
        yield _factor_knob("wind", "wind speed", "m/s", air.wind_speed_m_s, 4.0, edits.set_wind)


def _factor_knob(key: str, label: str, unit: str, value: float, factor: float, edit: Edit) -> Knob:
    """Return a knob that reaches from its value by a factor to both sides."""
    return Knob(
        key=key,
        label=label,
        unit=unit,
        low=value / factor,
        high=value * factor,
        value=value,
        log=True,
        edit=edit,
    )


def _model_knobs(config: Config) -> Iterator[Knob]:
    """Yield the knobs of the lines that filters assume."""
    lines = config.settings.model.vibrations
    if not lines:
        return
    filters = [method for method in all_methods().values() if method.estimator]
    methods = frozenset(method.name for method in filters)
    damping = edits.mean_damping(config)
    knob = _factor_knob("damping", "assumed damping", "", damping, 10.0, edits.set_damping)
    yield replace(knob, high=min(knob.high, 0.9), methods=methods)
    reach = min(_WIDEST_HZ, *(_NEAR * line.frequency_hz for line in lines))
    yield Knob(
        key="spread",
        label="half width of assumed bands",
        unit="Hz",
        low=0.0,
        high=reach,
        value=min(reach, *(line.spread_hz or 0.0 for line in lines)),
        methods=frozenset(method.name for method in filters if not method.needs_options),
        edit=edits.set_spread,
    )


def _method_knobs(method: Method, config: Config) -> Iterator[Knob]:
    """Yield the knobs of what a method declares a slider for: options, and keys of its section."""
    methods, section = frozenset({method.name}), edits.section_of(method, config)
    defaults = config.design_defaults
    for name, low, high in _declared_sliders(method.options):
        option = method.options.model_fields[name]
        value = option.examples[0] if option.is_required() and option.examples else option.default
        text, unit = _label(name)
        yield Knob(
            key=f"{method.name}-{name}",
            label=text,
            unit=unit,
            low=low,
            high=high,
            value=float(defaults.get(name, value)),
            methods=methods,
            option=name,
        )
    if section is None:
        return
    for name, low, high in _declared_sliders(type(section)):
        text, unit = _label(name)
        yield Knob(
            key=f"{method.name}-{name}",
            label=text,
            unit=unit,
            low=low,
            high=high,
            value=float(getattr(section, name)),
            methods=methods,
            edit=partial(edits.set_section_key, method, name),
        )
    if getattr(section, "bands", None):
        half = edits.mean_half_width_hz(section)
        edit = partial(edits.set_bands, method)
        knob = _factor_knob(
            f"{method.name}-band", "half width of the bands", "Hz", half, 10.0, edit
        )
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
