"""The section ``design.robust`` of a configuration: bands, sensor gains and demands."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import Field, model_validator

from lbt_synth.methods.method import Section
from lbt_synth.methods.quantities import (
    Gain,
    Hertz,
    HertzFromZero,
    Milliarcseconds,
    Nanometres,
    Ratio,
    RatioFromZero,
)

Axis: TypeAlias = Literal["tip", "tilt", "both"]


class BandSection(Section):
    """A band in which a vibration may be anywhere."""

    low_hz: HertzFromZero = Field(description="lower end of the band [Hz]")
    high_hz: Hertz = Field(description="upper end of the band [Hz]")
    rms_nm: Nanometres | None = Field(default=None, description="standard deviation [nm rms]")
    rms_mas: Milliarcseconds | None = Field(default=None, description="standard deviation [mas]")
    axis: Axis = Field(default="both", description="tip, tilt or both")
    damping: float | None = Field(default=None, ge=0, lt=1, description="damping ratio")

    @model_validator(mode="after")
    def _require_one_size(self) -> BandSection:
        if (self.rms_nm is None) == (self.rms_mas is None):
            raise ValueError("expected exactly one of rms_nm, rms_mas")
        return self


class AttenuationSection(Section):
    """One step of a mask on the rejection."""

    low_hz: HertzFromZero = Field(description="lower end of the band [Hz]")
    high_hz: Hertz = Field(description="upper end of the band [Hz]")
    at_most: Ratio = Field(description="largest modulus of the rejection in it")
    sensor_gain: Gain | None = Field(default=None, description="real sensor gain at which it holds")


class MirrorUncertaintySection(Section):
    """Relative uncertainty of the mirror in a band."""

    relative: Ratio = Field(description="relative error of the mirror's response")
    low_hz: HertzFromZero = Field(description="lower end of the band [Hz]")
    high_hz: Hertz = Field(description="upper end of the band [Hz]")


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
        json_schema_extra={"slider": [0.2, 0.8]},
    )
    noise_peak: Ratio | None = Field(
        default=None, description="largest amplification of noise at any frequency"
    )
    delay_error_frames: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="stable for delay errors up to this [frames], late or early, at every gain of "
        "sensor_gain (default: 0.1 where the mirror settles at once, else 0)",
    )
    command_stroke_nm: Nanometres | None = Field(
        default=None, description="largest rms of the commands [nm]"
    )
    command_step_nm: Nanometres | None = Field(
        default=None, description="largest rms of their steps [nm]"
    )
    attenuation: list[AttenuationSection] = Field(
        default=[], description="upper bounds on the rejection"
    )
    mirror_uncertainty: list[MirrorUncertaintySection] = Field(
        default=[], description="errors of the mirror for which the loop stays stable"
    )
    functions: int = Field(default=60, ge=1, le=1000, description="functions of the long parameter")
    pole: float = Field(default=0.7, ge=0, lt=1, description="common pole of these functions")
    states: int | None = Field(
        default=20, ge=2, le=1000, description="largest number of states per axis; null: any"
    )
    loss: RatioFromZero = Field(
        default=0.1, description="largest relative increase of the residual for fewer states"
    )
