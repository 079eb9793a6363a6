"""Numbers of a configuration by their paths, and the real loops of samples that differ by them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from typing import Any, cast

import numpy as np

from lbt_synth.config.build import (
    measurement_noise_nm,
    model_lines,
    true_vibrations_owner,
    turbulence_sections,
    vibration_numbers,
)
from lbt_synth.config.load import Config, build_config
from lbt_synth.config.schema import FileSection
from lbt_synth.errors import ConfigError, suggest_word
from lbt_synth.loop.ensemble import EnsembleVibration, LoopEnsemble, ensemble_vibration
from lbt_synth.models import Atmosphere
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray

Keys = tuple[str | int, ...]  # the path of a number, such as ("truth", "vibrations", 0, "rms_nm")
_KEY = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)((?:\[[0-9]{1,6}\])*)")
_WEATHER = ("seeing_arcsec", "wind_speed_m_s", "outer_scale_m")  # that loops may differ in
_LINE = ("frequency_hz", "damping", "rms_nm", "rms_mas")
_PYRAMID = ("photons", "read_noise_electrons", "modulation_lambda_over_d")


@lru_cache(maxsize=256)
def parse_path(path: str) -> Keys:
    """Parse a path into its keys."""
    keys: list[str | int] = []
    for word in path.split("."):
        match = _KEY.fullmatch(word)
        if match is None:
            raise ConfigError(
                f"{path!r} is no path in a configuration; expected one such as "
                "truth.vibrations[0].frequency_hz."
            )
        keys += [match[1], *map(int, re.findall(r"[0-9]+", match[2]))]
    return tuple(keys)


def find_number(content: Mapping[str, Any], path: str) -> float:
    """Return the number to which a path leads; refuse a path that leads to none."""
    value: Any = content
    for key in parse_path(path):
        names = range(len(value)) if isinstance(value, list) else value
        if not isinstance(value, list | dict) or key not in names:
            held = f"it is {value!r}"
            if isinstance(value, dict):
                held = suggest_word(str(key), sorted(value))
            elif isinstance(value, list):
                held = f"it is a list of {count_text(len(value), 'entry', 'entries')}, from [0]"
            raise ConfigError(f"{path} is not in the configuration: no {key} there; {held}")
        value = cast(Any, value)[key]
    if value is None:
        raise ConfigError(f"{path} is not set in the configuration, so it cannot be varied.")
    if type(value) not in (int, float):
        raise ConfigError(f"{path} must lead to a number; got a {type(value).__name__}.")
    return cast(float, value)


def set_number(
    content: dict[str, Any], keys: Keys, value: float, *, full: Mapping[str, Any]
) -> None:
    """Set a number that :func:`find_number` finds in ``full``, the content with its defaults.

    Missing sections on the way are added, missing lists copied. An integer stays one if it can.
    """
    section: Any = content
    complete: Any = full
    for key in keys[:-1]:
        complete = complete[key]
        if isinstance(section, dict) and key not in section:
            section[key] = deepcopy(complete) if isinstance(complete, list) else {}
        section = section[key]
    is_integer = isinstance(complete[keys[-1]], int) and value.is_integer()
    section[keys[-1]] = int(value) if is_integer else value


def _with_value(section: Any, keys: Keys, value: Any) -> Any:
    """Return a section or list with another value at its keys, which is not checked."""
    if not keys:
        return value
    first, rest = keys[0], keys[1:]
    if isinstance(first, int):
        inner = _with_value(section[first], rest, value)
        return [*section[:first], inner, *section[first + 1 :]]
    return section.model_copy(update={first: _with_value(getattr(section, first), rest, value)})


def with_values(settings: FileSection, values: Mapping[Keys, Any]) -> FileSection:
    """Return settings with other values, or arrays (b,) of samples that differ, unchecked."""
    for keys, numbers in values.items():
        settings = _with_value(settings, keys, numbers)
    return settings


def at_frame_rate(config: Config, frame_rate_hz: float) -> Config:
    """Return a configuration at another frame rate, of the same star: the photons per second stay.

    The delay in frames stays, and a pyramid's read noise per frame. A noise in nm or mas counts as
    that of photons, whose variance grows as the rate. Other sensors are left out.
    """
    settings, ratio = config.settings, frame_rate_hz / config.hardware.frame_rate_hz
    if any(section.kind == "ar" for section in turbulence_sections(settings)):
        raise ConfigError(
            f"{config.source}: model.turbulence of kind ar is known at "
            f"{config.hardware.frame_rate_hz:g} Hz alone. Give an atmosphere and kind ar1 or ar2.",
            path="model.turbulence",
        )
    values: dict[Keys, Any] = {("loop", "frame_rate_hz"): frame_rate_hz, ("sensors",): None}
    sensor = settings.sensor
    if sensor.pyramid is not None:
        values["sensor", "pyramid", "photons"] = sensor.pyramid.photons / ratio
    else:
        name = "noise_nm" if sensor.noise_mas is None else "noise_mas"
        values["sensor", name] = (np.sqrt(ratio) * np.array(getattr(sensor, name))).tolist()
    return build_config(with_values(settings, values), config.source)


def array_keys(settings: FileSection) -> set[Keys]:
    """Return the keys of the numbers that :func:`build_ensemble` takes as arrays.

    Samples that differ by any other number are different configurations.
    """
    truth, model, sensor = settings.truth, settings.model, settings.sensor
    kinds = {section.kind for section in turbulence_sections(settings)}
    if settings.true_turbulence != "model":
        kinds = set()
    keys: set[Keys] = {("loop", "delay_frames"), ("truth", "sensor_gain")}
    if not isinstance(model.sensor_gain, list):
        keys.add(("model", "sensor_gain"))
    if "ar2" not in kinds:  # which is fitted above the noise
        if not isinstance(sensor.noise_nm, list):
            keys |= {("sensor", "noise_nm"), ("sensor", "noise_mas")}
        keys |= {("sensor", "pyramid", name) for name in _PYRAMID}
    if kinds <= {"ar"}:
        keys |= {("atmosphere", name) for name in _WEATHER}
    for owner, vibrations in (("model", model.vibrations), ("truth", truth.vibrations)):
        for i, line in enumerate(vibrations if isinstance(vibrations, list) else ()):
            # the lines of a spread vibration are chosen for one frequency, damping and size
            if getattr(line, "spread_hz", None) is None:
                keys |= {(owner, "vibrations", i, name) for name in _LINE}
    return keys


def build_ensemble(
    config: Config,
    values: Mapping[Keys, FloatArray],
    *,
    delay_error_frames: FloatArray,
    noise_factor: FloatArray,
) -> LoopEnsemble:
    """Build the real loops of b samples, which differ by some numbers of :func:`array_keys`.

    The configuration is that of one of them. Their real delays less those of the configuration, and
    their real noise over it, are (b,).
    """
    settings, flows = with_values(config.settings, values), None
    delay = settings.loop.delay_frames + delay_error_frames
    for extreme in (np.min(delay), np.max(delay)):
        replace(config.hardware, delay_frames=float(extreme))  # refuses what no loop has
    if settings.true_turbulence == "frozen_flow":
        air: Any = settings.atmosphere
        weather = {name: getattr(air, name) for name in _WEATHER}
        if differing := {name: values for name, values in weather.items() if np.ndim(values)}:
            flows = replace(cast(Atmosphere, config.atmosphere), **differing)
    noise = np.asarray(measurement_noise_nm(settings))
    if not isinstance(settings.sensor.noise_nm, list):
        noise = noise[..., None]
    return LoopEnsemble(
        sensor_gain=settings.truth.sensor_gain / config.sensor_gain,
        delay_frames=delay,
        noise_nm=noise * noise_factor[:, None],
        turbulence=config.truth.turbulence if flows is None else flows,
        vibrations=tuple(_ensemble_vibrations(config, settings)),
        loops=len(noise_factor),
    )


def _ensemble_vibrations(config: Config, settings: FileSection) -> list[EnsembleVibration]:
    """Return the vibrations of the samples; the lines of a spread one are the same for all."""
    if true_vibrations_owner(settings) == "truth":
        rows = vibration_numbers(settings, "truth")
        return [EnsembleVibration(**numbers) for _, _, numbers in rows]
    vibrations: list[EnsembleVibration] = []
    lines = model_lines(config.settings)
    for (*_, numbers), (section, _, spread) in zip(
        vibration_numbers(settings, "model"), lines, strict=True
    ):
        one = section.spread_hz is None
        vibrations += [EnsembleVibration(**numbers)] if one else map(ensemble_vibration, spread)
    return vibrations
