"""The robust controller: the section ``design.robust`` of a configuration, and its design."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from pydantic import Field

from lbt_synth.errors import ConfigError, ProblemError, name_key
from lbt_synth.methods.method import DesignInputs, Method, Section, exactly_one
from lbt_synth.methods.quantities import (
    Gain,
    Hertz,
    HertzFromZero,
    Milliarcseconds,
    Nanometres,
    Ratio,
    RatioFromZero,
)
from lbt_synth.models.resonance_spectrum import WIDE_DAMPING

if TYPE_CHECKING:
    from lbt_synth.design.loop_shaping import ShapedDesign
    from lbt_synth.design.shaping import VibrationBand
    from lbt_synth.design.shaping.demands import Demand
    from lbt_synth.models import Spectrum, TipTiltPlant

Axis: TypeAlias = Literal["tip", "tilt", "both"]
_KEY = "design.robust"
_AXES: dict[Axis, int] = {"tip": 0, "tilt": 1}
_MOST_BANDS = 6  # around lines of a plant
_BAND = 0.02  # half width of such a band, over its frequency
_PLANT_FUNCTIONS = 30  # of the parameter for a plant, which is not reduced: that takes longer
_PLAIN = {"moving_gain", "modulus_margin", "delay_error_frames", "functions", "pole"}
_PLAIN |= {"states", "loss"}  # options that robust takes as they are


class BandSection(Section):
    """A band in which a vibration may be anywhere."""

    low_hz: HertzFromZero = Field(description="lower end of the band [Hz]")
    high_hz: Hertz = Field(description="upper end of the band [Hz]")
    rms_nm: Nanometres | None = Field(default=None, description="standard deviation [nm rms]")
    rms_mas: Milliarcseconds | None = Field(default=None, description="standard deviation [mas]")
    axis: Axis = Field(default="both", description="tip, tilt or both")
    damping: float | None = Field(default=None, ge=0, lt=1, description="damping ratio")

    _one_size = exactly_one("rms_nm", "rms_mas")


class BoundSection(Section):
    """A bound on a response of the loop, in a band or at all frequencies."""

    response: Literal["rejection", "noise", "complementary"] = Field(
        description="rejection of disturbances, amplification of noise, or T"
    )
    at_most: Ratio = Field(description="its largest modulus")
    low_hz: HertzFromZero = Field(default=0.0, description="lower end of the band [Hz]")
    high_hz: Hertz | None = Field(default=None, description="upper end of the band [Hz]")
    sensor_gain: Gain | None = Field(
        default=None, description="real sensor gain at which a rejection is bounded"
    )


class RobustSection(Section):
    """The robust design: bands of vibrations, sensor gains, demands."""

    bands: list[BandSection] = Field(
        min_length=1, description="bands with a vibration anywhere in them"
    )
    turbulence: Literal["frozen_flow", "model"] | None = Field(
        default=None, description="frozen_flow or model (default: as the truth)"
    )
    sensor_gain: list[Gain] | None = Field(
        default=None,
        min_length=2,
        max_length=2,
        description="[low, high]: stable for every real sensor gain between",
    )
    moving_gain: bool = Field(
        default=False, description="stable while the gain moves in sensor_gain, at any speed"
    )
    scenarios: list[Gain] | None = Field(
        default=None,
        min_length=1,
        description="real sensor gains whose residuals are minimised together",
    )
    modulus_margin: float = Field(
        default=0.45,
        ge=1e-3,
        lt=1,
        description="least modulus margin at model.sensor_gain",
    )
    delay_error_frames: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="stable for delay errors up to this [frames], late or early, at every gain of "
        "sensor_gain (default: 0.1 where the mirror settles at once, else 0)",
    )
    stroke_ratio: float | None = Field(
        default=None, gt=1, le=1e4, description="stable with commands of that many strokes, clipped"
    )
    command_stroke_nm: Nanometres | None = Field(
        default=None, description="largest rms of the commands [nm]"
    )
    command_step_nm: Nanometres | None = Field(
        default=None, description="largest rms of their steps [nm]"
    )
    bounds: list[BoundSection] = Field(
        default=[], description="upper bounds on responses of the loop"
    )
    functions: int = Field(default=60, ge=1, le=1000, description="functions of the long parameter")
    pole: float = Field(default=0.7, ge=0, lt=1, description="common pole of these functions")
    states: int | None = Field(
        default=20, ge=2, le=1000, description="largest number of states per axis; null: any"
    )
    loss: RatioFromZero = Field(
        default=0.1, description="largest relative increase of the residual for fewer states"
    )


def _build(inputs: DesignInputs, _: Section) -> ShapedDesign:
    """Design the controller; the section's sensor gains are real, the design's are relative."""
    from lbt_synth.design.loop_shaping import robust

    section: RobustSection | None = inputs.defaults.get(ROBUST.name)
    if not inputs.defaults:  # there is no configuration
        section = _plant_section(inputs.plant)
    if section is None:
        raise ConfigError(
            f"the key {_KEY} is missing: the robust design needs its bands at least. "
            "lbt_robust.yaml of lbt-synth init --examples has it.",
            path=_KEY,
        )
    assumed, arguments = inputs.sensor_gain, section.model_dump(include=_PLAIN)
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
    spectrum = None if section.turbulence == "model" else inputs.atmosphere
    if section.turbulence == "frozen_flow" and spectrum is None:
        raise ConfigError(
            f"the key atmosphere is missing: {_KEY}.turbulence: frozen_flow is its spectrum. Give "
            f"it, or {_KEY}.turbulence: model.",
            path="atmosphere",
        )
    with name_key(_KEY):
        return robust(
            inputs.plant.own_sensor_alone(),
            bands=_build_bands(inputs, section),
            turbulence=spectrum,
            demands=_list_demands(inputs, section, spectrum),
            **arguments,
        )


def _build_bands(inputs: DesignInputs, section: RobustSection) -> list[list[VibrationBand]]:
    """Return the bands, one list per mode."""
    from lbt_synth.design.shaping import VibrationBand

    modes = inputs.plant.hardware.modes
    bands: list[list[VibrationBand]] = [[] for _ in range(modes)]
    for i, band in enumerate(section.bands):
        key = f"{_KEY}.bands[{i}]"
        rms_nm, axis = inputs.size_nm(band, key), _AXES.get(band.axis)
        if axis is not None and modes != 2:
            raise ConfigError(
                f"{key}.axis: this loop has {modes} axes: leave axis out.", path=f"{key}.axis"
            )
        ends = {"low_hz": band.low_hz, "high_hz": band.high_hz}
        for mode in range(modes) if axis is None else (axis,):
            dampings = (  # of the model's vibrations in the band
                line.damping
                for line in inputs.plant.vibrations
                if band.low_hz <= line.frequency_hz <= band.high_hz and line.direction[mode]
            )
            damping = max(dampings, default=0.0) if band.damping is None else band.damping
            with name_key(key):
                bands[mode].append(VibrationBand(**ends, rms_nm=rms_nm, damping=damping))
    return bands


def _list_demands(
    inputs: DesignInputs, section: RobustSection, spectrum: Spectrum | None
) -> list[Demand]:
    """Return the demands of the section, those on commands under the turbulence of the design."""
    from lbt_synth.design.loop_shaping import noise_per_mode
    from lbt_synth.design.shaping import Bound, CommandRms, LoopErrors
    from lbt_synth.models.spectra import spectrum_groups

    demands: list[Demand] = []
    for i, bound in enumerate(section.bounds):
        gain = 1.0 if bound.sensor_gain is None else bound.sensor_gain / inputs.sensor_gain
        with name_key(f"{_KEY}.bounds[{i}]"):
            demands.append(Bound(**{**bound.model_dump(), "sensor_gain": gain}))
    if section.stroke_ratio is not None:
        influence = inputs.plant.hardware.influence
        if np.any(np.count_nonzero(influence, axis=1) != 1) or np.diff(influence.shape):
            raise ConfigError(
                f"{_KEY}.stroke_ratio: each command must move one axis alone, as a clipped one "
                "would turn the others; got a mirror.influence_matrix that mixes them.",
                path=f"{_KEY}.stroke_ratio",
            )
        demands.append(LoopErrors(low=1 / section.stroke_ratio, moving=True))
    commands_nm = {False: section.command_stroke_nm, True: section.command_step_nm}
    models = inputs.plant.turbulence
    for rate, at_most_nm in commands_nm.items():
        if at_most_nm is None:
            continue
        if spectrum is None and len(spectrum_groups(models)) > 1:
            raise ConfigError(
                f"{_KEY}: bounds on the commands hold under one turbulence for all axes, but "
                "model.turbulence has one per axis. Leave command_stroke_nm and command_step_nm "
                "out, or give one model.",
                path=_KEY,
            )
        alone = inputs.plant.own_sensor_alone()
        noise_nm = float(max(noise_per_mode(alone.hardware, alone.R)))
        turbulence = models[0] if spectrum is None else spectrum
        demands.append(
            CommandRms(at_most_nm=at_most_nm, rate=rate, turbulence=turbulence, noise_nm=noise_nm)
        )
    return demands


def _plant_section(plant: TipTiltPlant) -> RobustSection:
    """Return bands around the strongest lines of a plant, those that overlap as one."""
    # wide resonances need no band, and would swallow those of the lines
    narrow = [line for line in plant.vibrations if line.damping <= WIDE_DAMPING]
    lines = sorted(narrow or plant.vibrations, key=lambda line: -line.rms_nm)
    nyquist_hz = plant.hardware.frame_rate_hz / 2
    bands: list[BandSection] = []
    for line in sorted(lines[:_MOST_BANDS], key=lambda line: line.frequency_hz):
        half = max(_BAND * line.frequency_hz, line.damping * line.frequency_hz)
        low, high = max(line.frequency_hz - half, 0.0), min(line.frequency_hz + half, nyquist_hz)
        axes = line.direction if len(line.direction) == 2 else (1.0, 1.0)
        shaken = [name for name, mode in _AXES.items() if axes[mode]]
        axis: Axis = shaken[0] if len(shaken) == 1 else "both"
        rms_nm, damping = line.rms_nm, line.damping
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
    return RobustSection(bands=bands, functions=_PLANT_FUNCTIONS, states=None)


ROBUST = Method(
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
