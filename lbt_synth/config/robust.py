"""The robust design of a configuration file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from lbt_synth.config.builders import rms_nm
from lbt_synth.config.load import Config
from lbt_synth.config.schema import BandSection
from lbt_synth.design import ShapedDesign, robust
from lbt_synth.design.shaped_design import noise_of_modes
from lbt_synth.design.shaping import (
    Attenuation,
    CommandRms,
    DelayError,
    MirrorUncertainty,
    NoisePeak,
    VibrationBand,
)
from lbt_synth.design.shaping.demand_types import Demand
from lbt_synth.errors import ConfigError, ProblemError
from lbt_synth.models import Spectrum
from lbt_synth.models.truth import spectrum_key

_KEY = "design.robust"


def robust_design(config: Config) -> ShapedDesign:
    """Design the robust controller that the section ``design.robust`` describes.

    Sensor gains of the file are real ones; the design takes them relative to
    ``model.sensor_gain``.

    Parameters
    ----------
    config : Config
        The configuration.

    Returns
    -------
    ShapedDesign
        Certified design.

    Raises
    ------
    ConfigError
        If the section is missing, or a value in it does not fit.
    SynthesisError
        If no such controller is found.
    """
    section = config.settings.design.robust
    if section is None:
        raise ConfigError(
            f"{config.source}: the key {_KEY} is missing: the robust design needs its bands at "
            "least. Try examples/lbt_robust.yaml.",
            path=_KEY,
        )
    believed = config.sensor_gain
    if section.sensor_gain is not None:
        low, high = section.sensor_gain
        if not low <= believed <= high:
            key = f"{_KEY}.sensor_gain"
            raise ConfigError(
                f"{config.source}: {key}: must hold model.sensor_gain, {believed:g}; got "
                f"{low:g} to {high:g}.",
                path=key,
            )
    kind = section.turbulence or config.settings.usual_turbulence
    spectrum: Spectrum | None = None
    if kind == "frozen_flow":
        spectrum = config.air(
            f"{_KEY}.turbulence: frozen_flow is its spectrum. Give it, or {_KEY}.turbulence: model"
        )
    try:
        bands = [
            _entry(
                config,
                f"bands[{i}]",
                VibrationBand,
                low_hz=band.low_hz,
                high_hz=band.high_hz,
                rms_nm=_band_rms_nm(config, band, f"{_KEY}.bands[{i}]"),
            )
            for i, band in enumerate(section.bands)
        ]
        arguments: dict[str, Any] = {
            "bands": bands,
            "turbulence": spectrum,
            "modulus_margin": section.modulus_margin,
            "demands": _demands(config, spectrum),
            "functions": section.functions,
            "pole": section.pole,
            "states": section.states,
            "loss": section.loss,
        }
        if section.sensor_gain is not None:
            arguments["sensor_gain"] = tuple(gain / believed for gain in section.sensor_gain)
        if section.scenarios is not None:
            arguments["scenarios"] = tuple(gain / believed for gain in section.scenarios)
        return robust(config.plant, **arguments)
    except ConfigError:
        raise
    except ProblemError as error:
        raise ConfigError(f"{config.source}: {_KEY}: {error}", path=_KEY) from error


T = TypeVar("T")


def _band_rms_nm(config: Config, band: BandSection, key: str) -> float:
    """Return the deviation of a band's sinusoid [nm]."""
    try:
        return rms_nm(band, config.settings, key)
    except ConfigError as error:
        raise ConfigError(f"{config.source}: {error}", path=error.path) from error


def _entry(config: Config, name: str, kind: Callable[..., T], **values: float) -> T:
    """Make one entry of a list; what is wrong with it is said with its key."""
    key = f"{_KEY}.{name}"
    nyquist_hz = config.settings.loop.frame_rate_hz / 2
    if values["high_hz"] > nyquist_hz:
        raise ConfigError(
            f"{config.source}: {key}: must lie below the Nyquist frequency {nyquist_hz:.6g} Hz; "
            f"got up to {values['high_hz']:g} Hz.",
            path=key,
        )
    try:
        return kind(**values)
    except ProblemError as error:
        raise ConfigError(f"{config.source}: {key}: {error}", path=key) from error


def _demands(config: Config, spectrum: Spectrum | None) -> list[Demand]:
    section = config.settings.design.robust
    assert section is not None  # of a robust design
    believed = config.sensor_gain
    out: list[Demand] = []
    if section.noise_peak is not None:
        out.append(NoisePeak(at_most=section.noise_peak))
    if section.delay_error_frames is not None:
        out.append(DelayError(frames=section.delay_error_frames))
    out += [
        _entry(
            config,
            f"attenuation[{i}]",
            Attenuation,
            low_hz=step.low_hz,
            high_hz=step.high_hz,
            at_most=step.at_most,
            sensor_gain=1.0 if step.sensor_gain is None else step.sensor_gain / believed,
        )
        for i, step in enumerate(section.attenuation)
    ]
    out += [
        _entry(
            config,
            f"mirror_uncertainty[{i}]",
            MirrorUncertainty,
            relative=part.relative,
            low_hz=part.low_hz,
            high_hz=part.high_hz,
        )
        for i, part in enumerate(section.mirror_uncertainty)
    ]
    noise = float(max(noise_of_modes(config.hardware, config.plant.R)))
    turbulence = spectrum
    if turbulence is None:
        turbulence = config.plant.turbulence[0]
        bounded = section.command_stroke_nm is not None or section.command_step_nm is not None
        if bounded and len({spectrum_key(model) for model in config.plant.turbulence}) > 1:
            raise ConfigError(
                f"{config.source}: {_KEY}: bounds on the commands hold under one turbulence for "
                "all axes, but model.turbulence has one an axis. Leave command_stroke_nm and "
                "command_step_nm out, or give one model.",
                path=_KEY,
            )
    for bound, rate in ((section.command_stroke_nm, False), (section.command_step_nm, True)):
        if bound is not None:
            out.append(
                CommandRms(at_most_nm=bound, turbulence=turbulence, noise_nm=noise, rate=rate)
            )
    return out
