"""The method of the robust controller, which the section ``design.robust`` describes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from lbt_synth.errors import ConfigError, ProblemError, name_key
from lbt_synth.methods.method import DesignInputs, Method, Section
from lbt_synth.methods.robust_section import Axis, BandSection, RobustSection
from lbt_synth.models.resonance_spectrum import WIDE_DAMPING

if TYPE_CHECKING:
    from lbt_synth.design.loop_shaping import ShapedDesign
    from lbt_synth.design.shaping.specification import Demand
    from lbt_synth.models import Spectrum, TipTiltPlant, Vibration

T = TypeVar("T")
_KEY = "design.robust"
_AXES: dict[Axis, int] = {"tip": 0, "tilt": 1}
_MOST_BANDS = 6  # around lines of a plant
_BAND = 0.02  # half width of such a band, over its frequency
_PLANT_FUNCTIONS = 30  # of the parameter for a plant, which is not reduced: that takes longer
_GAIN_BAND, _GAIN_MARGIN, _GAIN_FUNCTIONS = 0.003, 0.25, 60  # if only the gain is uncertain


def _build(inputs: DesignInputs, _: Section) -> ShapedDesign:
    """Design the controller; the section's sensor gains are real, the design's are relative."""
    from lbt_synth.design.robust import robust

    section: RobustSection | None = inputs.method_section(METHOD.name)
    if section is None:
        raise ConfigError(
            f"the key {_KEY} is missing: the robust design needs its bands at least. "
            "lbt_robust.yaml of lbt-synth init --examples has it.",
            path=_KEY,
        )
    assumed = inputs.sensor_gain
    arguments: dict[str, Any] = {
        name: getattr(section, name)
        for name in (
            "moving_gain",
            "modulus_margin",
            "delay_error_frames",
            "functions",
            "pole",
            "states",
            "loss",
        )
    }
    if section.sensor_gain is not None:
        low, high = section.sensor_gain
        if not low <= assumed <= high:
            key = f"{_KEY}.sensor_gain"
            raise ConfigError(
                f"{key}: must hold model.sensor_gain, {assumed:g}; got {low:g} to {high:g}.",
                path=key,
            )
        arguments["sensor_gain"] = (low / assumed, high / assumed)
    if section.scenarios is not None:
        arguments["scenarios"] = tuple(gain / assumed for gain in section.scenarios)
    with name_key(_KEY):
        spectrum = _choose_spectrum(inputs, section)
        bands = _build_bands(inputs, section)
        demands = _list_demands(inputs, section, spectrum)
        plant = inputs.plant.own_sensor_alone()
        return robust(plant, bands=bands, turbulence=spectrum, demands=demands, **arguments)


def _choose_spectrum(inputs: DesignInputs, section: RobustSection) -> Spectrum | None:
    """Return the spectrum of the turbulence, None for that of the model."""
    if section.turbulence == "model" or (section.turbulence is None and inputs.atmosphere is None):
        return None
    if inputs.atmosphere is None:
        raise ConfigError(
            f"the key atmosphere is missing: {_KEY}.turbulence: frozen_flow is its spectrum. Give "
            f"it, or {_KEY}.turbulence: model.",
            path="atmosphere",
        )
    return inputs.atmosphere


def _build_bands(inputs: DesignInputs, section: RobustSection) -> list[Any]:
    """Return the bands, one list per mode."""
    from lbt_synth.design.shaping import VibrationBand

    modes = inputs.hardware.modes
    out: list[list[Any]] = [[] for _ in range(modes)]
    for i, band in enumerate(section.bands):
        rms_nm = inputs.size_nm(band, f"{_KEY}.bands[{i}]")
        axis = _AXES.get(band.axis)
        if axis is not None and modes != 2:
            key = f"{_KEY}.bands[{i}].axis"
            raise ConfigError(f"{key}: this loop has {modes} axes: leave axis out.", path=key)
        for mode in range(modes) if axis is None else (axis,):
            damping = _model_damping(inputs, band, mode) if band.damping is None else band.damping
            entry = {"low_hz": band.low_hz, "high_hz": band.high_hz, "rms_nm": rms_nm}
            entry["damping"] = damping
            out[mode].append(_build_entry(inputs, f"bands[{i}]", VibrationBand, entry))
    return out


def _model_damping(inputs: DesignInputs, band: BandSection, mode: int) -> float:
    """Return the largest damping of the model's vibrations of a mode in a band, 0 without one."""
    found = (
        line.damping
        for line in inputs.plant.vibrations
        if band.low_hz <= line.frequency_hz <= band.high_hz and line.direction[mode]
    )
    return max(found, default=0.0)


def _build_entry(
    inputs: DesignInputs, name: str, kind: Callable[..., T], values: Mapping[str, Any]
) -> T:
    """Build one entry of a list; an error names its key."""
    key = f"{_KEY}.{name}"
    nyquist_hz = inputs.hardware.frame_rate_hz / 2
    if values["high_hz"] > nyquist_hz:
        raise ConfigError(
            f"{key}: must lie below the Nyquist frequency {nyquist_hz:.6g} Hz; got up to "
            f"{values['high_hz']:g} Hz.",
            path=key,
        )
    with name_key(key):
        return kind(**values)


def _list_demands(
    inputs: DesignInputs, section: RobustSection, spectrum: Spectrum | None
) -> list[Demand]:
    from lbt_synth.design.shaping import Attenuation, MirrorUncertainty, NoisePeak

    out: list[Demand] = []
    if section.noise_peak is not None:
        out.append(NoisePeak(at_most=section.noise_peak))
    for i, step in enumerate(section.attenuation):
        gain = 1.0 if step.sensor_gain is None else step.sensor_gain / inputs.sensor_gain
        entry = step.model_dump() | {"sensor_gain": gain}
        out.append(_build_entry(inputs, f"attenuation[{i}]", Attenuation, entry))
    for i, part in enumerate(section.mirror_uncertainty):
        name = f"mirror_uncertainty[{i}]"
        out.append(_build_entry(inputs, name, MirrorUncertainty, part.model_dump()))
    return out + _list_command_bounds(inputs, section, spectrum)


def _list_command_bounds(
    inputs: DesignInputs, section: RobustSection, spectrum: Spectrum | None
) -> list[Demand]:
    from lbt_synth.design.loop_shaping import noise_per_mode
    from lbt_synth.design.shaping import CommandRms
    from lbt_synth.models.spectra import spectrum_key

    given = ((section.command_stroke_nm, False), (section.command_step_nm, True))
    bounds = [(bound, rate) for bound, rate in given if bound is not None]
    models = inputs.plant.turbulence
    if bounds and spectrum is None and len({spectrum_key(model) for model in models}) > 1:
        raise ConfigError(
            f"{_KEY}: bounds on the commands hold under one turbulence for all axes, but "
            "model.turbulence has one per axis. Leave command_stroke_nm and command_step_nm "
            "out, or give one model.",
            path=_KEY,
        )
    bound_commands = partial(
        CommandRms,
        turbulence=models[0] if spectrum is None else spectrum,
        noise_nm=float(max(noise_per_mode(inputs.hardware, inputs.plant.own_sensor_alone().R))),
    )
    return [bound_commands(at_most_nm=bound, rate=rate) for bound, rate in bounds]


def _plant_section(
    plant: TipTiltPlant, sensor_gains: tuple[float, float] | None = None
) -> RobustSection:
    """Return bands around the strongest lines of a plant, those that overlap as one.

    With sensor gains, these are what is uncertain, and the bands are narrow. Wide resonances need
    no band, and would swallow those of the lines.
    """
    share = _BAND if sensor_gains is None else _GAIN_BAND
    narrow = [line for line in plant.vibrations if line.damping <= WIDE_DAMPING]
    lines = sorted(narrow or plant.vibrations, key=lambda line: -line.rms_nm)
    nyquist_hz = plant.hardware.frame_rate_hz / 2
    bands: list[BandSection] = []
    for line in sorted(lines[:_MOST_BANDS], key=lambda line: line.frequency_hz):
        half = max(share * line.frequency_hz, line.damping * line.frequency_hz)
        low, high = max(line.frequency_hz - half, 0.0), min(line.frequency_hz + half, nyquist_hz)
        axis, rms_nm, damping = _axis(line), line.rms_nm, line.damping
        last = bands[-1] if bands else None
        if last is not None and low <= last.high_hz:
            bands.pop()
            low, high = min(last.low_hz, low), max(last.high_hz, high)
            axis = axis if axis == last.axis else "both"
            rms_nm = float(np.hypot(last.rms_nm or 0.0, rms_nm))
            damping = max(last.damping or 0.0, damping)
        bands.append(
            BandSection(low_hz=low, high_hz=high, rms_nm=rms_nm, axis=axis, damping=damping)
        )
    if not bands:
        raise ProblemError("a robust controller is for vibrations; the plant has none.")
    if sensor_gains is None:
        return RobustSection(bands=bands, functions=_PLANT_FUNCTIONS, states=None)
    gains = [min(sensor_gains[0], 1.0), max(sensor_gains[1], 1.0)]
    return RobustSection(
        bands=bands,
        sensor_gain=gains,
        modulus_margin=_GAIN_MARGIN,
        functions=_GAIN_FUNCTIONS,
        states=None,
    )


def _axis(line: Vibration) -> Axis:
    """Return the axis that a line of two axes shakes."""
    if len(line.direction) != 2:
        return "both"
    shaken = [name for name, mode in _AXES.items() if line.direction[mode]]
    return shaken[0] if len(shaken) == 1 else "both"


METHOD = Method(
    name="robust",
    title="robust controller",
    label="robust",
    estimator=False,
    options=Section,
    section=RobustSection,
    plant_section=_plant_section,
    build=_build,
    design="lbt_synth.design.loop_shaping:ShapedDesign",
)
