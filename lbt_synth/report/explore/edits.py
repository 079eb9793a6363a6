"""Edits of the content of a configuration file, each made by one slider."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from lbt_synth.config import Config
from lbt_synth.methods.method import Method
from lbt_synth.models import Vibration
from lbt_synth.models.vibration import stationary_vibrations

Content: TypeAlias = dict[str, Any]
_MOST_DAMPING = 0.99


def set_delay(_: Config, content: Content, delay_frames: float) -> None:
    """Set the delay of the loop, which designs know."""
    content["loop"]["delay_frames"] = delay_frames


def set_sensor_gain(config: Config, content: Content, gain: float) -> None:
    """Set the real sensor gain; gains of several measurements keep their proportions."""
    truth = content.setdefault("truth", {})
    factor = gain / (config.truth.sensor_gain * config.sensor_gain)
    truth["sensor_gain"] = _scaled(truth.get("sensor_gain", 1.0), factor)


def set_noise(config: Config, content: Content, noise_nm: float) -> None:
    """Set the noise, the root mean square of those of several measurements."""
    sensor = content["sensor"]
    given = np.broadcast_to(config.noise_nm, np.shape(config.noise_nm)).tolist()
    for name in ("noise_mas", "pyramid"):
        sensor.pop(name, None)
    sensor["noise_nm"] = _scaled(given, noise_nm / mean_noise_nm(config))


def mean_noise_nm(config: Config) -> float:
    """Return the root mean square of the noise of all measurements [nm]."""
    return float(np.sqrt(np.mean(np.square(config.noise_nm))))


def set_seeing(_: Config, content: Content, seeing_arcsec: float) -> None:
    """Set the seeing."""
    content["atmosphere"]["seeing_arcsec"] = seeing_arcsec


def set_wind(_: Config, content: Content, wind_speed_m_s: float) -> None:
    """Set the wind speed."""
    content["atmosphere"]["wind_speed_m_s"] = wind_speed_m_s


def set_shift(config: Config, content: Content, shift_hz: float) -> None:
    """Move the true lines, the one that moves most by a shift; those of the model stay."""
    for line in _true_lines(config, content):
        place_hz = line["frequency_hz"]
        percent = line.pop("frequency_error_percent", None)
        if percent is not None:
            line["frequency_error_hz"] = place_hz * percent / 100  # so that it stays as it is
        line["frequency_hz"] += config.truth.frequency_shift_hz(place_hz, shift_hz)


def set_damping(config: Config, content: Content, damping: float) -> None:
    """Set the mean damping of the lines of the model; those of the truth stay."""
    _true_lines(config, content)
    factor = damping / mean_damping(config)
    for line in content["model"]["vibrations"]:
        line["damping"] = min(line["damping"] * factor, _MOST_DAMPING)


def mean_damping(config: Config) -> float:
    """Return the geometric mean of the damping of the lines of the model."""
    lines = config.settings.model.vibrations or ()
    return float(np.exp(np.mean(np.log([line.damping for line in lines]))))


def set_spread(config: Config, content: Content, spread_hz: float) -> None:
    """Spread the lines of the model over bands of a half width; those of the truth stay."""
    _true_lines(config, content)
    for line in content["model"]["vibrations"]:
        if spread_hz > 0:
            line["spread_hz"] = spread_hz
        else:
            line.pop("spread_hz", None)
            line.pop("lines", None)


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


def set_section_key(
    method: Method, name: str, config: Config, content: Content, value: float
) -> None:
    """Set a key of a method's section."""
    section_content(method, config, content)[name] = value


def set_bands(method: Method, config: Config, content: Content, half_width_hz: float) -> None:
    """Set the mean half width of the bands of a method's section; their middles stay."""
    factor = half_width_hz / mean_half_width_hz(section_of(method, config))
    highest = config.hardware.frame_rate_hz / 2
    for band in section_content(method, config, content)["bands"]:
        low, high = band["low_hz"], band["high_hz"]
        middle, half = (low + high) / 2, factor * (high - low) / 2
        band |= {"low_hz": max(middle - half, 0.0), "high_hz": min(middle + half, highest)}


def mean_half_width_hz(section: Any) -> float:
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


def _scaled(value: Any, factor: float) -> Any:
    """Return a number, or each of a list, times a factor."""
    return [factor * one for one in value] if isinstance(value, list) else factor * value
