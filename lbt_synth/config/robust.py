"""The robust design that a configuration describes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from lbt_synth.config.load import Config
from lbt_synth.config.plant_and_truth import vibration_rms_nm
from lbt_synth.config.schema import RobustSection
from lbt_synth.config.telescope_and_atmosphere import require_atmosphere
from lbt_synth.design import ShapedDesign, robust
from lbt_synth.design.shaped_design import noise_per_mode
from lbt_synth.design.shaping import (
    Attenuation,
    CommandRms,
    DelayError,
    MirrorUncertainty,
    NoisePeak,
    VibrationBand,
)
from lbt_synth.design.shaping.specification import Demand
from lbt_synth.errors import ConfigError, name_file, name_key
from lbt_synth.models import Spectrum
from lbt_synth.models.spectra import spectrum_key

T = TypeVar("T")
_KEY = "design.robust"


def design_robust(config: Config) -> ShapedDesign:
    """Design the robust controller that the section ``design.robust`` describes.

    Sensor gains in the file are real; the design takes them relative to ``model.sensor_gain``.
    """
    with name_file(config.source), name_key(_KEY):
        return _design(config)


def _design(config: Config) -> ShapedDesign:
    section = config.settings.design.robust
    if section is None:
        raise ConfigError(
            f"the key {_KEY} is missing: the robust design needs its bands at least. Try "
            "examples/lbt_robust.yaml.",
            path=_KEY,
        )
    assumed = config.sensor_gain
    if section.sensor_gain is not None:
        low, high = section.sensor_gain
        if not low <= assumed <= high:
            key = f"{_KEY}.sensor_gain"
            raise ConfigError(
                f"{key}: must hold model.sensor_gain, {assumed:g}; got {low:g} to {high:g}.",
                path=key,
            )
    spectrum: Spectrum | None = None
    if (section.turbulence or config.settings.usual_turbulence) == "frozen_flow":
        spectrum = config.atmosphere
        require_atmosphere(
            config.settings,
            f"{_KEY}.turbulence: frozen_flow is its spectrum. Give it, or {_KEY}.turbulence: model",
        )
    bands = []
    for i, band in enumerate(section.bands):
        rms = vibration_rms_nm(band, config.settings, f"{_KEY}.bands[{i}]")
        entry = {"low_hz": band.low_hz, "high_hz": band.high_hz, "rms_nm": rms}
        bands.append(_build_entry(config, f"bands[{i}]", VibrationBand, entry))
    arguments: dict[str, Any] = {
        "bands": bands,
        "turbulence": spectrum,
        "modulus_margin": section.modulus_margin,
        "demands": _list_demands(config, section, spectrum),
        "functions": section.functions,
        "pole": section.pole,
        "states": section.states,
        "loss": section.loss,
    }
    if section.sensor_gain is not None:
        arguments["sensor_gain"] = tuple(gain / assumed for gain in section.sensor_gain)
    if section.scenarios is not None:
        arguments["scenarios"] = tuple(gain / assumed for gain in section.scenarios)
    return robust(config.plant, **arguments)


def _build_entry(
    config: Config, name: str, kind: Callable[..., T], values: Mapping[str, float]
) -> T:
    """Build one entry of a list; an error names its key."""
    key = f"{_KEY}.{name}"
    nyquist_hz = config.settings.loop.frame_rate_hz / 2
    if values["high_hz"] > nyquist_hz:
        raise ConfigError(
            f"{key}: must lie below the Nyquist frequency {nyquist_hz:.6g} Hz; got up to "
            f"{values['high_hz']:g} Hz.",
            path=key,
        )
    with name_key(key):
        return kind(**values)


def _list_demands(
    config: Config, section: RobustSection, spectrum: Spectrum | None
) -> list[Demand]:
    out: list[Demand] = []
    if section.noise_peak is not None:
        out.append(NoisePeak(at_most=section.noise_peak))
    if section.delay_error_frames is not None:
        out.append(DelayError(frames=section.delay_error_frames))
    for i, step in enumerate(section.attenuation):
        gain = 1.0 if step.sensor_gain is None else step.sensor_gain / config.sensor_gain
        entry = step.model_dump() | {"sensor_gain": gain}
        out.append(_build_entry(config, f"attenuation[{i}]", Attenuation, entry))
    for i, part in enumerate(section.mirror_uncertainty):
        name = f"mirror_uncertainty[{i}]"
        out.append(_build_entry(config, name, MirrorUncertainty, part.model_dump()))
    noise = float(max(noise_per_mode(config.hardware, config.plant.R)))
    turbulence = spectrum
    if turbulence is None:
        turbulence = config.plant.turbulence[0]
        bounded = section.command_stroke_nm is not None or section.command_step_nm is not None
        if bounded and len({spectrum_key(model) for model in config.plant.turbulence}) > 1:
            raise ConfigError(
                f"{_KEY}: bounds on the commands hold under one turbulence for all axes, but "
                "model.turbulence has one per axis. Leave command_stroke_nm and command_step_nm "
                "out, or give one model.",
                path=_KEY,
            )
    for bound, rate in ((section.command_stroke_nm, False), (section.command_step_nm, True)):
        if bound is not None:
            out.append(
                CommandRms(at_most_nm=bound, turbulence=turbulence, noise_nm=noise, rate=rate)
            )
    return out
