"""The schema of a configuration file, with units in its keys; unknown keys are refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import Discriminator, Field, Tag, create_model, model_validator

from lbt_synth.config.section import Section
from lbt_synth.config.sensor_sections import (
    MotionSection,
    OtherSensorSection,
    SensorSection,
    with_own_sensor,
)
from lbt_synth.methods import quantities as q
from lbt_synth.methods.registry import METHODS
from lbt_synth.models.loop_hardware import LONGEST_DELAY


class TelescopeSection(Section):
    """The pupil."""

    diameter_m: q.Metres = Field(le=1e3, description="diameter of the pupil [m]")
    obstruction: float = Field(
        default=0.0,
        ge=0,
        le=0.99,
        description="central obstruction over the diameter",
    )


class AtmosphereSection(Section):
    """The turbulence; ``outer_scale_m: null`` is Kolmogorov."""

    seeing_arcsec: q.Arcseconds = Field(description="seeing [arcsec]")
    outer_scale_m: q.Metres | None = Field(description="outer scale [m], null for Kolmogorov")
    wind_speed_m_s: q.MetresPerSecond = Field(description="wind speed [m/s]")
    seeing_wavelength_um: q.Micrometres = Field(
        default=0.5, description="wavelength of the seeing [um]"
    )


class LocalLoopSection(Section):
    """The mirror's local position loop: its gains, or the frequency and damping they make."""

    natural_frequency_hz: q.Hertz = Field(description="frequency of the mode itself [Hz]")
    damping: q.RatioFromZero = Field(description="damping ratio of that mode")
    bandwidth_hz: q.Hertz | None = Field(default=None, description="frequency with the loop [Hz]")
    bandwidth_damping: q.Ratio | None = Field(
        default=None, description="damping with the loop, 0.7"
    )
    proportional_per_s2: float | None = Field(
        default=None, ge=0, le=1e12, description="position gain [1/s^2]"
    )
    derivative_per_s: q.RatioFromZero | None = Field(
        default=None, description="velocity gain [1/s]"
    )
    feed_forward: q.RatioFromZero = Field(
        default=1.0, description="feed-forward over holding force"
    )
    sampling_hz: q.Hertz = Field(
        default=72_000.0, description="rate, whole multiple of the frame rate [Hz]"
    )
    delay_samples: q.Whole = Field(
        default=1, description="computing delay of the local loop [samples]"
    )
    ramp_samples: q.Count = Field(default=1, description="samples over which a command is ramped")

    @model_validator(mode="after")
    def _require_one_kind_of_gains(self) -> LocalLoopSection:
        gains = (self.proportional_per_s2 is not None, self.derivative_per_s is not None)
        if gains[0] != gains[1] or gains[0] == (self.bandwidth_hz is not None):
            raise ValueError(
                "expected either bandwidth_hz (and bandwidth_damping), or both of "
                "proportional_per_s2 and derivative_per_s"
            )
        if self.bandwidth_damping is not None and self.bandwidth_hz is None:
            raise ValueError("bandwidth_damping goes with bandwidth_hz, and only with it")
        return self


class MirrorSection(Section):
    """Deformable mirror; ``modes`` counts the controlled ones, for modal designs and end to end."""

    modes: q.Count | None = Field(default=None, description="number of controlled modes")
    influence_matrix: list[list[q.Entry]] | None = Field(
        default=None, description="rows: modes by commands (default: identity)"
    )
    local_loop: LocalLoopSection | None = Field(
        default=None, description="position loop (default: it settles at once)"
    )


class LoopSection(Section):
    """Timing, and how many axes there are."""

    axes: int | None = Field(default=None, ge=1, le=2, description="number of axes (default 2)")
    frame_rate_hz: q.Hertz = Field(ge=0.1, description="frame rate [Hz]")
    delay_frames: float = Field(
        default=2.0, ge=1, le=LONGEST_DELAY, description="total delay [frames]"
    )


class _LineSection(Section):
    # which of axis and direction_deg is needed depends on the number of axes
    axis: Literal["tip", "tilt", "both"] | None = Field(
        default=None, description="tip, tilt or both"
    )
    direction_deg: q.Degrees | None = Field(
        default=None, description="angle from tip to tilt [deg]"
    )
    frequency_hz: q.Hertz = Field(description="frequency [Hz], below half the frame rate")
    rms_nm: q.Nanometres | None = Field(default=None, description="standard deviation [nm rms]")
    rms_mas: q.Milliarcseconds | None = Field(default=None, description="standard deviation [mas]")
    frequency_error_hz: q.HertzFromZero | None = Field(
        default=None, description="how far the true frequency may be off [Hz]; 0 where it is known"
    )
    frequency_error_percent: q.RatioFromZero | None = Field(
        default=None, description="the same in percent of the frequency"
    )
    accelerometers: dict[str, MotionSection] | None = Field(
        default=None, description="accelerometer channels that move with it"
    )

    @model_validator(mode="after")
    def _require_one_size_and_direction(self) -> _LineSection:
        if (self.rms_nm is None) == (self.rms_mas is None):
            raise ValueError("expected exactly one of rms_nm, rms_mas")
        if self.axis is not None and self.direction_deg is not None:
            raise ValueError("expected exactly one of axis, direction_deg")
        if None not in (self.frequency_error_hz, self.frequency_error_percent):
            raise ValueError("expected one of frequency_error_hz, frequency_error_percent")
        return self

    @property
    def largest_error_hz(self) -> float | None:
        """How far the true frequency may be off [Hz], None where it is not stated."""
        if self.frequency_error_percent is None:
            return self.frequency_error_hz
        return self.frequency_hz * self.frequency_error_percent / 100


class VibrationSection(_LineSection):
    """A vibration of the model; ``spread_hz`` makes several ``lines`` of it."""

    damping: q.Damping = Field(description="damping ratio")
    spread_hz: q.Hertz | None = Field(default=None, description="half width of its interval [Hz]")
    lines: int | None = Field(
        default=None, ge=1, le=64, description="how many lines cover it (default 5)"
    )

    @model_validator(mode="after")
    def _require_spread_of_lines(self) -> VibrationSection:
        if self.lines is not None and self.spread_hz is None:
            raise ValueError("lines goes with spread_hz, and only with it")
        return self


class TrueVibrationSection(_LineSection):
    """A vibration of the truth: a sinusoid, a resonance with its damping, or one that drifts."""

    kind: Literal["sinusoid", "resonance", "drift"] = Field(
        description="sinusoid, resonance or drift"
    )
    damping: q.Damping | None = Field(
        default=None, description="damping ratio of a resonance or a drift"
    )
    end_hz: q.Hertz | None = Field(default=None, description="frequency at the end of a drift [Hz]")
    duration_s: q.Seconds | None = Field(default=None, description="duration of a drift [s]")

    @model_validator(mode="after")
    def _require_what_the_kind_needs(self) -> TrueVibrationSection:
        if self.kind != "drift" and (self.kind == "resonance") != (self.damping is not None):
            raise ValueError(
                "damping goes with kind: resonance, and only with it or with kind: drift"
            )
        for given in (self.end_hz, self.duration_s):
            if (self.kind == "drift") != (given is not None):
                raise ValueError("end_hz and duration_s go with kind: drift, and only with it")
        return self


class Ar1Section(Section):
    """AR1 turbulence, from the atmosphere."""

    kind: Literal["ar1"] = Field(description="first order, from the atmosphere")


class Ar2Section(Section):
    """AR2 turbulence, fitted to the atmosphere's spectrum above the noise."""

    kind: Literal["ar2"] = Field(description="second order, from the atmosphere")


class ArSection(Section):
    """Auto-regressive turbulence by its coefficients."""

    kind: Literal["ar"] = Field(description="any order, by its coefficients")
    coefficients: list[q.Entry] = Field(min_length=1, description="of past values, newest first")
    driving_rms_nm: float = Field(ge=1e-6, le=1e6, description="rms of the driving noise [nm]")


TurbulenceSection = Annotated[Ar1Section | Ar2Section | ArSection, Field(discriminator="kind")]


class ModelSection(Section):
    """What the design assumes; leave ``vibrations`` out for a plant without any."""

    turbulence: Annotated[
        Annotated[TurbulenceSection, Tag(q.ONE)]
        | Annotated[list[TurbulenceSection], Field(min_length=1), Tag(q.EACH)],
        Discriminator(q.tag_one_or_each),
    ] = Field(description="model of the turbulence, or one per axis")
    vibrations: list[VibrationSection] | None = Field(
        default=None, min_length=1, description="the vibrations, if there are any"
    )
    sensor_gain: q.GainOrEach = Field(
        default=1.0, description="sensor gain that the design assumes, or one per measurement"
    )


class TruthSection(Section):
    """What the real loop meets; ``vibrations: model`` takes those of the model."""

    turbulence: Literal["frozen_flow", "model", "none"] | None = Field(
        default=None,
        description="spectrum of the turbulence",
    )
    vibrations: Annotated[
        Annotated[Literal["model"], Tag(q.ONE)]
        | Annotated[list[TrueVibrationSection], Tag(q.EACH)],
        Discriminator(q.tag_one_or_each),
    ] = Field(default=[], description="the vibrations, or model: those of the model")
    sensor_gain: q.GainOrEach = Field(
        default=1.0, description="real sensor gain, or one per measurement"
    )


class ImagingSection(Section):
    """The camera."""

    wavelength_um: q.Micrometres = Field(
        default=2.2, description="wavelength of the Strehl ratio [um]"
    )
    other_modes_strehl: q.Fraction = Field(
        default=1.0, description="Strehl ratio of all other modes"
    )


def _design_section() -> type[Section]:
    """Return the defaults of the synthesis: options of the methods, and their own sections."""
    fields: dict[str, Any] = {}
    for method in METHODS.values():
        for name in sorted(method.configurable):
            option = method.options.model_fields[name]
            fields[name] = (option.annotation, option)
        if method.section is not None:
            fields[method.name] = (method.section | None, Field(None, description=method.title))
    return create_model("DesignSection", __base__=Section, **fields)


if TYPE_CHECKING:
    DesignSection: TypeAlias = Any
else:
    DesignSection = _design_section()


class SimulationSection(Section):
    """Time-domain runs."""

    frames: q.Count = Field(default=8000, ge=2, description="frames recorded")
    cases: q.Count = Field(default=4, description="independent runs")
    seed: int = Field(default=0, ge=0, lt=2**128, description="seed of the random series")
    settle_frames: q.Whole = Field(default=2000, description="frames before those recorded")


class RobustnessSection(Section):
    """The studies over a frequency error, a sensor gain and a delay error."""

    errors_hz: Annotated[list[q.Shift], Field(min_length=1)] | None = Field(
        default=None,
        description="true frequency minus the assumed one, of the vibration that moves most [Hz] "
        "(default: 15 steps over the stated errors, or over 17.5 % and at most 3.5 Hz)",
    )
    hold: Literal["driving", "rms"] = Field(
        default="driving",
        description="what a shifted vibration keeps: its driving or its own rms",
    )
    sensor_gains: list[q.Gain] = Field(
        default=[x / 40 for x in range(10, 53)],
        min_length=1,
        description="real sensor gains of maps",
    )
    delay_errors_frames: list[q.Shift] = Field(
        default=[0.0], min_length=1, description="real delay minus the design's [frames]"
    )


class EndToEndSection(Section):
    """The end-to-end simulation; the other sections describe its system."""

    pixels: int = Field(default=60, ge=8, le=10_000, description="pixels across the pupil")
    frames: q.Count = Field(default=1600, ge=2, description="frames of the exposure")
    settle_frames: q.Count = Field(default=400, ge=200, description="frames before it")
    gain: q.RatioFromZero = Field(
        default=0.5, description="integrator gain of every mode without a filter"
    )
    leak: float = Field(default=0.97, ge=0, le=1, description="leak of the integrators")
    leak_from_mode: q.Count = Field(default=50, ge=2, description="first mode with a leak")
    actuators_across: int = Field(
        default=31, ge=3, le=1000, description="actuators across the mirror"
    )
    wind_direction_deg: q.Degrees = Field(
        default=0.0, description="direction of the wind [deg]; 0 is along tip"
    )
    calibration_nm: q.Nanometres = Field(
        default=20.0, description="amplitude of the calibration [nm]"
    )


class FileSection(Section):
    """A whole configuration file; an identified system knows no telescope and no atmosphere."""

    version: int = Field(ge=1, le=1, description="version of the layout: 1")
    units: Literal["nm", "um", "mas", "urad"] | None = Field(
        default=None, description="what commands show wavefronts in: nm (default), um, mas or urad"
    )
    telescope: TelescopeSection | None = Field(default=None, description="the pupil")
    atmosphere: AtmosphereSection | None = Field(default=None, description="the turbulence")
    sensor: SensorSection = Field(description="noise of the measurements")
    sensors: dict[str, OtherSensorSection] | None = Field(
        default=None, min_length=1, description="sensors beside the loop's own, by name"
    )
    mirror: MirrorSection = Field(default=MirrorSection(), description="the deformable mirror")
    loop: LoopSection = Field(description="timing, and the number of axes")
    model: ModelSection = Field(description="what the design assumes")
    truth: TruthSection = Field(default=TruthSection(), description="what the loop meets")
    imaging: ImagingSection = Field(
        default=ImagingSection(), description="the camera of the Strehl ratio"
    )
    design: DesignSection = Field(
        default=DesignSection(), description="defaults of the methods of synthesis"
    )
    simulation: SimulationSection = Field(
        default=SimulationSection(), description="time-domain runs"
    )
    robustness: RobustnessSection = Field(
        default=RobustnessSection(), description="errors that studies try"
    )
    end_to_end: EndToEndSection = Field(
        default=EndToEndSection(), description="the end-to-end simulation"
    )

    @model_validator(mode="before")
    @classmethod
    def _move_own_sensor(cls, raw: Any) -> Any:
        return with_own_sensor(raw)

    @property
    def usual_turbulence(self) -> str:
        """Turbulence of a truth that names none: frozen_flow if there is an atmosphere."""
        return "model" if self.atmosphere is None else "frozen_flow"

    @property
    def true_turbulence(self) -> str:
        """Turbulence that the real loop meets: frozen_flow, model or none."""
        return self.truth.turbulence or self.usual_turbulence


def config_schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration file.

    Every key has its description, with its unit. Rules over several keys, such as one of
    ``rms_nm`` and ``rms_mas``, are known to :func:`load_config` alone.

    Returns
    -------
    dict
        Schema of draft 2020-12, ready for :func:`json.dumps`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> schema = lbt.config.config_schema()
    >>> schema["$defs"]["LoopSection"]["properties"]["frame_rate_hz"]["description"]
    'frame rate [Hz]'
    """
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **FileSection.model_json_schema(), "title": "lbt-synth"}
